//! `picofarm demultiplex`: one flash taken apart by physics, or separate captures by published
//! methods.

mod picture;
mod read;

use std::time::Instant;

use futures::executor::block_on;
use picofarm_dataset::{RenderArray, SingleRender, write_render_group};
use picofarm_demultiplex::{
    DemultiplexError, Demultiplexed, DepthScore, MaskScore, Residual, SEPARATE_VERSION, Separate,
    Settings, Shading, VERSION, demultiplex, residual, score, separate,
};
use serde_json::{Map, json};

pub(super) use self::read::Flash;
use crate::{
    args::{Demultiplex, MethodArg, ShadowsArg},
    commands::rendered::unreadable,
    error::{CliError, Code, Result},
    output::{
        Output, duration,
        files::{free_folder, save},
    },
};

/// `demultiplex`.
///
/// # Errors
/// A render that cannot be read or used, or a folder that is taken.
pub async fn run(args: Demultiplex, output: Output) -> Result<()> {
    free_folder(&args.out)?;
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            let what = format!("cannot start {threads} threads: {e}");
            CliError::new(Code::Resource, what)
        })?;
    let made = tokio::task::spawn_blocking(move || pool.install(|| make(args)))
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("the method broke: {e}")))??;
    let mut facts = made.attributes["scores"].clone();
    facts["out"] = json!(made.args.out);
    facts["threads"] = json!(threads);
    facts["seconds"] = json!(made.seconds);
    output.result(&facts, || summary(&made));
    Ok(())
}

/// What was made.
struct Made {
    args: Demultiplex,
    attributes: Map<String, serde_json::Value>,
    depth: Option<DepthScore>,
    masks: Option<MaskScore>,
    mirrors: Option<f64>,
    residual: Option<Residual>,
    note: Option<String>,
    spots: usize,
    placed: usize,
    seconds: f64,
}

fn make(args: Demultiplex) -> Result<Made> {
    let flash = Flash::read(&args.render, args.places)?;
    let refused = |e: DemultiplexError| CliError::input(format!("{}: {e}", args.render.display()));
    let start = Instant::now();
    let (found, settings, version) = match args.method {
        MethodArg::Physics => {
            let settings = Settings {
                shadows: match args.shadows {
                    Some(ShadowsArg::Physics) => Shading::Physics,
                    Some(ShadowsArg::Learned) | None => Shading::Learned,
                },
                ..Settings::default()
            };
            let found = demultiplex(&flash.capture(), &settings).map_err(refused)?;
            (found, json!(settings), VERSION)
        }
        MethodArg::MatchedFilter => {
            let found = from_captures(&args, &flash, Separate::MatchedFilter)?;
            (found, json!({"method": "matched-filter"}), SEPARATE_VERSION)
        }
        MethodArg::Likelihood => {
            let found = from_captures(&args, &flash, Separate::Likelihood)?;
            (found, json!({"method": "likelihood"}), SEPARATE_VERSION)
        }
    };
    let seconds = start.elapsed().as_secs_f64();
    let truth = flash.truth();
    let depth = truth.as_ref().map(|t| score::depth(&found.depth_m, t));
    let masks = truth.as_ref().and_then(|t| score::masks(&found, t));
    let mirrors = truth.as_ref().and_then(|t| score::mirrors(&found, t));
    let residual = residual(&flash.capture(), &found);
    let attributes = json!({
        "demultiplexed": args.render.file_name().map(|n| n.to_string_lossy()),
        "scene": flash.attributes.get("scene"),
        "camera": flash.camera,
        "gate": flash.gate,
        "laser_origin": flash.laser,
        "beams": flash.beams,
        "places": found.places.iter().map(|p| p.map(|p| json!({"point": p.point, "path_m": p.path_m}))).collect::<Vec<_>>(),
        "depth": "z-depth, metres",
        "lit": "probability that the spot of each beam lights what a pixel sees",
        "ground": "what lit rests on: 0 = light, 1 = geometry alone, 2 = other spots' light comes at the same time",
        "mirror": "probability that a pixel sees a mirror; its depth is then the mirror's own",
        "albedo": "relative to the median pixel's",
        "confidence": "0 to 1: how well the histogram speaks for the depth",
        "settings": settings,
        "version": version,
        "scores": {"depth": depth, "masks": masks, "mirrors_iou": mirrors, "residual": residual, "note": flash.note()},
    });
    let attributes = attributes
        .as_object()
        .expect("written as an object")
        .clone();
    write(&args, &flash, &found, &attributes)?;
    let canvas = picture::draw(&flash, &found, truth.as_ref());
    save(&canvas, &args.out.join("picture.png"))?;
    Ok(Made {
        spots: found.places.len(),
        placed: found.places.iter().flatten().count(),
        args,
        attributes,
        depth,
        masks,
        mirrors,
        residual,
        note: flash.note(),
        seconds,
    })
}

/// The failure of a method that reads captures itself.
enum Failed {
    Method(DemultiplexError),
    Read(CliError),
}

impl From<DemultiplexError> for Failed {
    fn from(e: DemultiplexError) -> Self {
        Self::Method(e)
    }
}

/// Finds depth and shadows in the histograms of each spot.
fn from_captures(args: &Demultiplex, flash: &Flash, method: Separate) -> Result<Demultiplexed> {
    let folder = &args.render;
    if args.shadows.is_some() {
        let what = "--shadows is for --method physics";
        return Err(CliError::input(what).hint("leave it out"));
    }
    let none = || {
        let what = format!(
            "{}: has no histogram of each spot, which --method reads",
            folder.display()
        );
        CliError::input(what)
            .hint("render with --groups per-spot, or import the histograms of each spot; `scene sense` keeps only their sum")
    };
    if !SingleRender::is_in(folder) {
        return Err(none());
    }
    let single = block_on(SingleRender::open(folder)).map_err(|e| unreadable(folder, e))?;
    if !single.dataset.spec().per_spot {
        return Err(none());
    }
    let manifest = block_on(single.dataset.manifest(0)).map_err(|e| unreadable(folder, e))?;
    let mut read = |spot: usize| {
        let read = block_on(single.dataset.read_spot(0, flash.beams[spot] as u32));
        read.map_err(|e| Failed::Read(unreadable(folder, e)))
    };
    separate(&flash.capture(), method, manifest.scale, &mut read).map_err(|e| match e {
        Failed::Method(e) => CliError::input(format!("{}: {e}", folder.display())),
        Failed::Read(e) => e,
    })
}

fn write(
    args: &Demultiplex,
    flash: &Flash,
    found: &Demultiplexed,
    attributes: &Map<String, serde_json::Value>,
) -> Result<()> {
    let i = &flash.camera.intrinsics;
    let cube = [
        found.places.len() as u64,
        u64::from(i.height),
        u64::from(i.width),
    ];
    let ground: Vec<f32> = found.ground.iter().map(|g| f32::from(*g as u8)).collect();
    let image = |name, data| RenderArray {
        name,
        shape: &cube[1..],
        dimension_names: &["row", "column"],
        data,
    };
    let by_spot = |name, data| RenderArray {
        name,
        shape: &cube,
        dimension_names: &["spot", "row", "column"],
        data,
    };
    let mut arrays = vec![
        image("depth", &found.depth_m),
        image("confidence", &found.confidence),
        image("albedo", &found.albedo),
        by_spot("lit", &found.lit),
        by_spot("ground", &ground),
    ];
    if found.mirror.is_some() {
        arrays.push(image("mirror", &found.mirror_probability));
    }
    write_render_group(&args.out, &arrays, attributes).map_err(|e| CliError::new(Code::Resource, e))
}

fn summary(made: &Made) -> String {
    let mut text = format!(
        "{}: depth, and masks of {} spots, in {}; look at picture.png\n",
        made.args.out.display(),
        made.spots,
        duration(made.seconds),
    );
    if made.placed < made.spots {
        let lost = made.spots - made.placed;
        text += &format!("  {lost} spots have no return in the histogram and light nothing\n");
    }
    if let Some(r) = &made.residual {
        text += &format!(
            "  peaks of {} pairs agree with the depth to {:.4} m of path (wrong times have {:.4})\n",
            r.peaks, r.median_m, r.control_m
        );
    }
    if let Some(d) = &made.depth {
        text += &format!(
            "  depth: MAE {:.4} m without mirrors, median {:.1} mm, {:.1} % off by more than 5 cm",
            d.mae_m,
            d.median_m * 1e3,
            d.over_5cm * 100.0
        );
        if let Some(mirrors) = d.mirrors_mae_m {
            text += &format!("; mirrors {mirrors:.3} m");
        }
        text += "\n";
    }
    if let Some(m) = &made.masks {
        text += &format!(
            "  masks: IoU {:.3} over all pairs ({:.3} for \"all lit\")",
            m.iou, m.all_lit_iou
        );
        // The other methods judge every pair by its light.
        if made.args.method == MethodArg::Physics {
            text += &format!(", {:.3} over those that can carry light", m.iou_carrying);
        }
        text += "\n";
    }
    if let Some(iou) = made.mirrors {
        text += &format!("  mirrors: IoU {iou:.3}\n");
    }
    if let Some(note) = &made.note {
        text += &format!("  note: {note}\n");
    }
    text
}
