//! `picofarm reconstruct FOLDER`: a room from what was measured, or from a render's histograms. No
//! true scene is known, so there are no errors of novel views.

use std::time::Instant;

use futures::executor::block_on;
use picofarm_dataset::SingleRender;
use picofarm_demultiplex::{
    Settings as FlashSettings, Truth, VERSION, demultiplex, residual, score,
};
use picofarm_figures::{Canvas, TEXT, inferno, scene::quantile};
use picofarm_reconstruct::{
    Measured, Reconstructed,
    render::Renderer,
    score::around_unseen,
    source::{Captures, LIT_THRESHOLD, from_flash},
    surface,
};
use picofarm_results::Verdict;
use picofarm_scene::{Beam, Camera, Laser};
use picofarm_tasks::reconstruct::{CELL, facts, shaded};
use serde_json::{Value, json};

use super::{AROUND, Made, fit, grid_settings, mlp, orbit, refused, watch::Watch, written::write};
use crate::{
    args::{FieldArg, GateArgs, PlacesArg, Reconstruct, SpotsFrom, ViewsArg},
    commands::{demultiplex::Flash, rendered::unreadable},
    error::{CliError, Code, Result},
    output::{Output, duration},
    signals,
};

const GAP: usize = 8;
const BACKGROUND: [u8; 3] = [18, 18, 22];
const INK: [u8; 3] = [220, 220, 220];

/// Reconstructs what a folder has.
///
/// # Errors
/// Fails on an unusable folder or argument, or an interruption.
pub async fn run(args: Reconstruct, output: Output) -> Result<()> {
    check(&args)?;
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            let what = format!("cannot start {threads} threads: {e}");
            CliError::new(Code::Resource, what)
        })?;
    let watch = Watch::new(output, signals::stop_on_signal()?);
    let (args, watch, made) = tokio::task::spawn_blocking(move || {
        let made = pool.install(|| make(&args, &watch));
        (args, watch, made)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the reconstruction broke: {e}")))?;
    watch.finish();
    let made = made?;
    write(&args.out, &made)?;
    let [measuring, fitting, _] = made.seconds;
    let mut shown = made.metrics.clone();
    shown["out"] = json!(args.out);
    shown["threads"] = json!(threads);
    shown["verdict"] = json!(Verdict::of_reconstruction(&made.metrics));
    shown["seconds"] = json!({"measurements": measuring, "reconstruction": fitting});
    output.result(&shown, || summary(&args, &made));
    Ok(())
}

/// Rejects options of scene files.
fn check(args: &Reconstruct) -> Result<()> {
    let (input, networks) = (&args.input, &args.networks);
    let foreign = [
        ("--root", input.root.is_some()),
        ("--spots", input.spots.is_some()),
        ("--unit", input.unit.is_some()),
        (
            "the options of the camera",
            input.view != Default::default(),
        ),
        ("--resolution", args.resolution != Reconstruct::RESOLUTION),
        ("--samples", args.samples != Reconstruct::SAMPLES),
        ("--photons", args.detector.photons.is_some()),
        ("--views", args.views != ViewsArg::Around),
        (
            "--gate-start-m, --bin-width-m and --bins",
            args.gate != GateArgs::USUAL,
        ),
        ("--models", networks.models.is_some()),
        ("--tof", networks.tof.is_some()),
        ("--shadow", networks.shadow.is_some()),
        ("--specular", networks.specular.is_some()),
    ];
    if let Some((option, _)) = foreign.iter().find(|(_, given)| *given) {
        let what = format!(
            "{option}: a folder has its own histograms and calibration: {}",
            args.file.display()
        );
        return Err(CliError::input(what).hint("leave it out, or name a scene file"));
    }
    match args.source() {
        SpotsFrom::Captures | SpotsFrom::Flash => Ok(()),
        SpotsFrom::Truth | SpotsFrom::Predictions => {
            let what = format!(
                "--spots-from {}: {} is a folder, whose times come from its histograms",
                args.source().name(),
                args.file.display()
            );
            Err(CliError::input(what).hint("--spots-from flash, or --spots-from captures"))
        }
    }
}

fn make(args: &Reconstruct, watch: &Watch) -> Result<Made> {
    let start = Instant::now();
    let flash = Flash::read(&args.file, PlacesArg::Given)?;
    let (measured, separated) = match args.source() {
        SpotsFrom::Captures => (captures(args, &flash, watch)?, None),
        _ => {
            let (measured, facts) = from_sum(args, &flash, watch)?;
            (measured, Some(facts))
        }
    };
    let measuring = start.elapsed().as_secs_f64();
    let (start, settings) = (Instant::now(), grid_settings(args));
    let (reconstructed, networks) = match args.field {
        FieldArg::Grid => (fit(measured, settings, watch)?, None),
        FieldArg::Mlp => {
            let (made, settings) = mlp::fit(args, measured, settings, watch)?;
            (made, Some(settings))
        }
    };
    let fitting = start.elapsed().as_secs_f64();
    watch.step("pictures", 0.0);
    let mesh = surface(&reconstructed.field);
    let mut metrics = Value::Object(facts(&reconstructed, &mesh));
    metrics["scene"] = flash
        .attributes
        .get("scene")
        .cloned()
        .unwrap_or(Value::Null);
    metrics["spots_from"] = json!(args.source().name());
    metrics["settings"] = json!(settings);
    if let Some(networks) = networks {
        metrics["mlp"] = networks;
    }
    let captured = separated.is_none();
    if let Some(facts) = separated {
        metrics["flash"] = facts;
    }
    // The depths of one flash are compared before the surface is fitted, and stand in its facts.
    if let Some(truth) = flash.truth().filter(|_| captured) {
        let measured = &reconstructed.measured;
        let range = &reconstructed.depth.range;
        let z: Vec<f32> = (0..range.len())
            .map(|p| range[p] * measured.ray(p).dot(measured.camera.forward))
            .collect();
        metrics["depth"] = json!(depth_of_known(&z, &truth));
    }
    if let Some(note) = flash.note() {
        metrics["note"] = json!(note);
    }
    let renderer = Renderer::new(&reconstructed.field);
    let (range, side) = (&reconstructed.depth.range, CELL as u32);
    let views = around_unseen(&reconstructed.measured, range, &renderer, AROUND, side);
    Ok(Made {
        views: picture(&flash, &reconstructed, &renderer, &views),
        orbit: match views.is_empty() {
            true => orbit::orbit(&reconstructed, &[flash.camera]),
            false => orbit::orbit(&reconstructed, &views),
        },
        glb: mesh.glb(&reconstructed.measured).map_err(refused)?,
        reconstructed,
        mesh,
        metrics,
        seconds: [measuring, fitting, 0.0],
    })
}

/// The error of depths, and the share of the pixels of known depth that have none.
fn depth_of_known(z: &[f32], truth: &Truth) -> Value {
    let known: Vec<f32> = truth
        .depth_m
        .iter()
        .zip(z)
        .map(|(t, z)| if z.is_finite() { *t } else { 0.0 })
        .collect();
    let count = |all: &[f32]| all.iter().filter(|z| **z > 0.0).count();
    let (with, all) = (count(&known), count(truth.depth_m));
    let truth = Truth {
        depth_m: &known,
        ..*truth
    };
    let mut found = match with {
        0 => json!({}),
        _ => json!(score::depth(z, &truth)),
    };
    found["without"] = json!(1.0 - with as f64 / all as f64);
    found
}

/// Takes the light of all spots apart. Returns the measurements, and how well the histogram and,
/// where it is known, the true depth agree with them.
fn from_sum(args: &Reconstruct, flash: &Flash, watch: &Watch) -> Result<(Measured, Value)> {
    watch.step("flash taken apart", 0.0);
    let capture = flash.capture();
    let found = demultiplex(&capture, &FlashSettings::default())
        .map_err(|e| CliError::input(format!("{}: {e}", args.file.display())))?;
    let truth = flash.truth();
    let facts = json!({
        "version": VERSION,
        "residual": residual(&capture, &found),
        "depth": truth.as_ref().map(|t| score::depth(&found.depth_m, t)),
        "masks": truth.as_ref().and_then(|t| score::masks(&found, t)),
    });
    let measured = from_flash(&capture, &found, &flash.beams).map_err(refused)?;
    Ok((measured, facts))
}

/// Measures times and shadows in the histograms of each spot alone.
fn captures(args: &Reconstruct, flash: &Flash, watch: &Watch) -> Result<Measured> {
    let single = block_on(SingleRender::open(&args.file)).map_err(|e| unreadable(&args.file, e))?;
    let spec = *single.dataset.spec();
    if !spec.per_spot {
        let what = format!(
            "{}: has one histogram of all spots, --spots-from captures needs one for each",
            args.file.display()
        );
        return Err(CliError::input(what)
            .hint("use --spots-from flash, or import the histograms of each spot"));
    }
    // Beams that meet nothing have no light in their histograms.
    let mut beams = vec![
        Beam {
            direction: flash.camera.forward,
            spot: None,
        };
        spec.spots as usize
    ];
    for (beam, spot) in flash.beams.iter().zip(&flash.spots) {
        beams[*beam].direction = spot.direction.normalized();
    }
    let laser = Laser {
        origin: flash.laser,
        beams,
    };
    let mut all = Captures::new(flash.camera, laser, flash.gate, LIT_THRESHOLD);
    for (done, beam) in flash.beams.iter().enumerate() {
        let of = flash.beams.len();
        if !watch.step(
            &format!("capture {} of {of}", done + 1),
            done as f32 / of as f32,
        ) {
            return Err(signals::interrupted("nothing was written"));
        }
        let histogram = block_on(single.dataset.read_spot(0, *beam as u32))
            .map_err(|e| unreadable(&args.file, e))?;
        all.add(*beam, &histogram).map_err(refused)?;
    }
    Ok(all.finish())
}

/// Draws the light that was measured next to the surface: from the camera, from the side, and from
/// behind.
fn picture(
    flash: &Flash,
    made: &Reconstructed,
    renderer: &Renderer<'_>,
    views: &[Camera],
) -> Canvas {
    let camera = &made.measured.camera;
    let by = |wanted: f32| {
        let off = |v: &Camera| (v.forward.dot(camera.forward) - wanted).abs();
        views.iter().min_by(|a, b| off(a).total_cmp(&off(b)))
    };
    let mut shown = vec![("3D, from the camera", camera)];
    shown.extend(by(0.0).map(|v| ("from the side", v)));
    // Straight back, the view would show only the space behind the camera.
    shown.extend(by(-0.6).map(|v| ("from behind", v)));
    let (step, top) = (CELL + GAP, GAP + TEXT + GAP);
    let mut canvas = Canvas::new(GAP + (1 + shown.len()) * step, top + CELL + GAP, BACKGROUND);
    canvas.text(GAP, GAP, "all light", INK);
    let light: Vec<f32> = flash
        .histogram
        .chunks_exact(flash.gate.bins as usize)
        .map(|h| h.iter().sum::<f32>().max(0.0).sqrt())
        .collect();
    let bright = quantile(&light, 0.98).max(f32::MIN_POSITIVE);
    let i = &camera.intrinsics;
    let size = (i.width as usize, i.height as usize);
    canvas.image((GAP, top), CELL, size, |p| inferno(light[p] / bright));
    for (k, (title, view)) in shown.into_iter().enumerate() {
        let at = GAP + (k + 1) * step;
        canvas.text(at, GAP, title, INK);
        let shade = shaded(renderer, view);
        canvas.image((at, top), CELL, (CELL, CELL), |p| [shade[p]; 3]);
    }
    canvas
}

fn summary(args: &Reconstruct, made: &Made) -> String {
    let m = &made.metrics;
    let mut text = format!(
        "{}: mesh of {} triangles from {} spots; look at views.png, mesh.glb and orbit.gif\n",
        args.out.display(),
        made.mesh.triangles.len(),
        m["spots"]
    );
    let depth = match m["depth"].is_object() {
        true => &m["depth"],
        false => &m["flash"]["depth"],
    };
    let figure = |name: &str| depth[name].as_f64();
    if let (Some(mae), Some(median), Some(over)) =
        (figure("mae_m"), figure("median_m"), figure("over_5cm"))
    {
        text += &format!(
            "  depth: MAE {mae:.4} m, median {:.1} mm, {:.1} % off by more than 5 cm",
            median * 1e3,
            over * 100.0
        );
        text += &match figure("without") {
            Some(without) => format!("; {:.1} % have none\n", without * 100.0),
            None => "\n".to_owned(),
        };
    }
    if let Some(note) = m["note"].as_str() {
        text += &format!("  note: {note}\n");
    }
    let [measuring, fitting, _] = made.seconds.map(duration);
    text += &format!("  measurements {measuring}, reconstruction {fitting}\n");
    text += &format!("  verdict: {}\n", Verdict::of_reconstruction(m).text);
    for note in &made.reconstructed.notes {
        text += &format!("  note: {note}\n");
    }
    text
}
