//! `picofarm scene …`: single scenes without a farm.

use std::{
    collections::BTreeMap,
    path::Path,
    sync::{
        Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Instant,
};

use picofarm_dataset::{RenderArray, write_render_group};
use picofarm_scene::{
    Bsdf, LaserGrid, Scene, export,
    furnished::{self, FurnishedSettings},
    import::{self, ImportOptions},
    primitive::{self, PrimitiveSettings},
};
use picofarm_transient::{
    Budget, Gate, Progress, RenderError, Rendered, Settings as RenderSettings, Strategy,
};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{FormatArg, GeneratorArg, Scene as Command, SceneExport, SceneRender},
    assets,
    error::{CliError, Code, Result, io},
    output::{Meter, Output, duration},
    roles, sense,
    settings::Settings,
    signals,
};

pub async fn run(command: Command, settings: &Settings, output: Output) -> Result<()> {
    match command {
        Command::Generate {
            kind,
            seed,
            out,
            spots,
            resolution,
            assets: name,
        } => {
            let scene = generate(kind, seed, spots, resolution, &name, settings)?;
            export::write_glb(&scene, &out)?;
            output.result(
                &json!({"file": out, "name": scene.name, "objects": scene.objects.len(), "triangles": scene.triangle_count()}),
                || format!(
                    "wrote {0}: {1} objects, {2} triangles; next: picofarm scene render {0} --out render",
                    out.display(), scene.objects.len(), scene.triangle_count()
                ),
            );
            Ok(())
        }
        Command::Show { file } => {
            let scene = import::read_scene(&file)?;
            scene.validate()?;
            let facts = facts(&scene);
            output.result(&facts, || describe(&scene));
            Ok(())
        }
        Command::Export(args) => export_scene(&args, output),
        Command::Render(args) => render(args, output).await,
        Command::Sense(args) => sense::run(args, output).await,
    }
}

/// `scene export`.
fn export_scene(args: &SceneExport, output: Output) -> Result<()> {
    let spots = args.spots.or(args.frame.then_some(25));
    let grid = |n: u32| {
        let what = format!("--spots {n}: there are grids of 1, 4, 16, 25 and 100 spots");
        LaserGrid::new(n).ok_or_else(|| CliError::input(what))
    };
    let options = ImportOptions {
        laser: spots.map(grid).transpose()?,
        frame: args.frame,
        ..ImportOptions::default()
    };
    let extension = args.out.extension().and_then(|e| e.to_str());
    let (format, name) = match (args.format, extension) {
        (Some(FormatArg::Glb), _) | (None, Some("glb")) => (FormatArg::Glb, "scene.glb"),
        (Some(FormatArg::Mitsuba), _) | (None, Some("xml")) => (FormatArg::Mitsuba, "scene.xml"),
        (Some(FormatArg::Ply), _) | (None, Some("ply")) => (FormatArg::Ply, "scene.ply"),
        _ => {
            return Err(
                CliError::input(format!("--out {}: names no format", args.out.display()))
                    .hint("end it in .glb, .xml or .ply, or state --format glb, mitsuba or ply"),
            );
        }
    };
    let scene = import::read_scene_with(&args.file, &options)?;
    let mut out = args.out.clone();
    if extension.is_none() || out.is_dir() {
        std::fs::create_dir_all(&out)
            .map_err(|e| io(format!("cannot make {}", out.display()), &e))?;
        out.push(name);
    }
    let mut notes = Vec::new();
    match format {
        FormatArg::Glb => export::write_glb(&scene, &out)?,
        FormatArg::Mitsuba => notes = export::write_mitsuba(&scene, &out)?,
        FormatArg::Ply => {
            export::write_ply(&scene, &out)?;
            notes.push("camera, laser, BSDFs and textures have no place in a PLY".into());
        }
    }
    output.result(
        &json!({"file": out, "name": scene.name, "objects": scene.objects.len(), "triangles": scene.triangle_count(), "notes": notes}),
        || {
            let mut text = format!("wrote {}: {} objects, {} triangles", out.display(), scene.objects.len(), scene.triangle_count());
            for note in &notes {
                text += &format!("\n  {note}");
            }
            text
        },
    );
    Ok(())
}

fn generate(
    kind: GeneratorArg,
    seed: u64,
    spots: u32,
    resolution: u32,
    assets: &str,
    settings: &Settings,
) -> Result<Scene> {
    match kind {
        GeneratorArg::Furnished => {
            let library = assets::library(assets, &settings.assets)?;
            let settings = FurnishedSettings {
                assets: library.name().to_owned(),
                specular_at_least: 1,
                spots,
                width: resolution,
                height: resolution,
                ..Default::default()
            };
            Ok(furnished::generate(seed, &settings, &library)?)
        }
        GeneratorArg::Primitive => {
            let settings = PrimitiveSettings {
                spots,
                width: resolution,
                height: resolution,
                ..Default::default()
            };
            Ok(primitive::generate(seed, &settings)?)
        }
    }
}

fn facts(scene: &Scene) -> serde_json::Value {
    let mut labels = BTreeMap::<&str, u32>::new();
    for o in &scene.objects {
        *labels
            .entry(scene.labels[usize::from(o.label)].as_str())
            .or_default() += 1;
    }
    let materials = || scene.objects.iter().flat_map(|o| &o.mesh.materials);
    let mirrors = materials().filter(|m| m.is_specular()).count();
    let rough = materials()
        .filter(|m| matches!(m.bsdf, Bsdf::RoughConductor { .. }))
        .count();
    let mixed = materials()
        .filter(|m| matches!(m.bsdf, Bsdf::Mixed { .. }))
        .count();
    let textured = materials().filter(|m| m.texture.is_some()).count();
    json!({
        "name": scene.name,
        "objects": scene.objects.len(),
        "triangles": scene.triangle_count(),
        "labels": labels,
        "mirror_materials": mirrors,
        "rough_conductor_materials": rough,
        "mixed_materials": mixed,
        "textured_materials": textured,
        "camera": scene.camera,
        "laser_origin": scene.laser.origin,
        "beams": scene.laser.beams.len(),
        "provenance": scene.provenance,
    })
}

fn describe(scene: &Scene) -> String {
    let f = facts(scene);
    let labels: Vec<String> = f["labels"]
        .as_object()
        .into_iter()
        .flatten()
        .map(|(name, n)| format!("{name} {n}"))
        .collect();
    let i = &scene.camera.intrinsics;
    let mut text = format!(
        "{}: {} objects, {} triangles\nmaterials: {} mirror, {} rough conductor, {} mixed, {} textured\nlabels: {}\ncamera: {}x{} pixels, focal length {} px, at {:?}\nlaser: {} beams from {:?}\nsource: {}\n",
        scene.name,
        scene.objects.len(),
        scene.triangle_count(),
        f["mirror_materials"],
        f["rough_conductor_materials"],
        f["mixed_materials"],
        f["textured_materials"],
        labels.join(", "),
        i.width,
        i.height,
        i.fx,
        <[f32; 3]>::from(scene.camera.origin),
        scene.laser.beams.len(),
        <[f32; 3]>::from(scene.laser.origin),
        scene.provenance.source,
    );
    for (key, value) in &scene.provenance.notes {
        text += &format!("  {key}: {value}\n");
    }
    for line in &scene.provenance.attribution {
        text += &format!("  {line}\n");
    }
    text
}

/// Shows progress; a cancelled token stops the render.
struct Watcher {
    done: AtomicU32,
    meter: Mutex<Meter>,
    stop: CancellationToken,
}

impl Progress for Watcher {
    fn at(&self, done: f32) -> bool {
        let share = (done * 1e6) as u32;
        if self.done.fetch_max(share, Ordering::Relaxed) < share
            && let Ok(mut meter) = self.meter.try_lock()
        {
            meter.at(f64::from(done), "rendering".into());
        }
        !self.stop.is_cancelled()
    }
}

async fn render(args: SceneRender, output: Output) -> Result<()> {
    let mut scene = import::read_scene(&args.file)?;
    if let Some(px) = args.resolution {
        if !(1..=4096).contains(&px) {
            return Err(CliError::input(format!(
                "--resolution {px}: expected 1 to 4096 pixels"
            )));
        }
        let i = &mut scene.camera.intrinsics;
        *i = i.resized(px, px);
    }
    let settings = RenderSettings {
        gate: Gate {
            start_m: args.gate.gate_start_m,
            bin_width_m: args.gate.bin_width_m,
            bins: args.gate.bins,
        },
        budget: match args.error {
            Some(e) => Budget::Error(e as f32),
            None => Budget::Samples(args.samples.unwrap_or(64)),
        },
        max_bounces: args.max_bounces,
        one_bounce: true,
        seed: args.seed,
        split: args.split,
        groups: vec![],
        strategy: Strategy::default(),
    };
    free_folder(&args.out)?;
    let stop = signals::stop_on_signal()?;
    let threads = args.threads.unwrap_or_else(roles::cores).max(1);
    let watcher = Watcher {
        done: AtomicU32::new(0),
        meter: Mutex::new(Meter::new(output)),
        stop,
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            CliError::new(
                Code::Resource,
                format!("cannot start {threads} threads: {e}"),
            )
        })?;
    let start = Instant::now();
    let (scene, settings, watcher, rendered) = tokio::task::spawn_blocking(move || {
        let rendered = pool.install(|| picofarm_transient::render(&scene, &settings, &watcher));
        (scene, settings, watcher, rendered)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the renderer broke: {e}")))?;
    if let Ok(meter) = watcher.meter.into_inner() {
        meter.finish();
    }
    let rendered = rendered.map_err(|e| match e {
        RenderError::Stopped => signals::interrupted("nothing was written"),
        e => CliError::input(e),
    })?;
    let seconds = start.elapsed().as_secs_f64();
    write(&args.out, &scene, &settings, &rendered)?;
    let e = &rendered.error;
    output.result(
        &json!({
            "out": args.out, "seconds": seconds, "threads": threads, "rays": rendered.rays,
            "error": e, "overflow": rendered.overflow, "plan": rendered.plan,
        }),
        || {
            let mut text = format!(
                "{}: {} paths a pixel, median error {:.2} %, total {:.2} %, {} on {threads} thread(s), {:.1} M rays\n",
                args.out.display(), e.samples, e.median_relative * 100.0, e.total_relative * 100.0,
                duration(seconds), rendered.rays as f64 / 1e6,
            );
            for line in &rendered.plan.strategies {
                text += &format!("  {line}\n");
            }
            for line in &rendered.plan.approximations {
                text += &format!("  approximated: {line}\n");
            }
            text
        },
    );
    Ok(())
}

/// Refuses early what the writer would refuse after the render.
pub fn free_folder(out: &Path) -> Result<()> {
    let taken = match std::fs::read_dir(out) {
        Ok(mut entries) => entries.next().is_some(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => false,
        Err(e) => return Err(io(format!("--out {}", out.display()), &e)),
    };
    if taken {
        return Err(
            CliError::input(format!("--out {}: the folder is not empty", out.display()))
                .hint("name a new folder; nothing is overwritten"),
        );
    }
    Ok(())
}

fn write(out: &Path, scene: &Scene, settings: &RenderSettings, r: &Rendered) -> Result<()> {
    let (h, w, b) = (
        u64::from(r.height),
        u64::from(r.width),
        u64::from(r.gate.bins),
    );
    let cube = [h, w, b];
    let histogram = |name, data| RenderArray {
        name,
        shape: &cube,
        dimension_names: &["row", "column", "bin"],
        data,
    };
    let mut arrays = vec![
        histogram("transient", &r.transient),
        RenderArray {
            name: "depth",
            shape: &cube[..2],
            dimension_names: &["row", "column"],
            data: &r.truth.depth,
        },
    ];
    if let Some(s) = &r.split {
        arrays.extend([
            histogram("two", &s.two),
            histogram("two_se", &s.two_se),
            histogram("multi", &s.multi),
            histogram("multi_se", &s.multi_se),
            histogram("multi_noise", &s.multi_noise),
        ]);
    }
    let attributes = json!({
        "scene": scene.name,
        "provenance": scene.provenance,
        "value": "radiance reaching the pixel per unit pulse energy, averaged over its footprint, integrated over the bin; 1/(m2 sr)",
        "transient": "all bounces; two: exactly two; multi: three and more; *_se: standard errors; multi_noise: a draw of the error of multi, whose square summed over any pixels and bins estimates that sum's variance",
        "gate": r.gate,
        "settings": settings,
        "camera": scene.camera,
        "laser_origin": scene.laser.origin,
        "spots": r.spots,
        "error": r.error,
        "overflow": r.overflow,
        "plan": r.plan,
        "renderer": picofarm_transient::RENDERER_VERSION,
    });
    let attributes = attributes.as_object().expect("written as an object");
    write_render_group(out, &arrays, attributes).map_err(|e| CliError::new(Code::Resource, e))
}
