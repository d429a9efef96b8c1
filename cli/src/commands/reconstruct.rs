//! `picofarm reconstruct`: reconstructs one scene file without a farm.

mod flash;
mod folder;
mod mlp;
pub(crate) mod orbit;
#[cfg(feature = "networks")]
mod predicted;
#[cfg(not(feature = "networks"))]
#[path = "reconstruct/without_networks.rs"]
mod predicted;
mod watch;
mod written;

use std::time::Instant;

use picofarm_figures::Canvas;
use picofarm_proto::spec::{
    kinds::reconstruct::grid_bytes,
    memory::{Shape, gib},
};
use picofarm_reconstruct::{
    Measured, ReconstructError, Reconstructed, Reconstruction, Settings, Shadows, Surface, World,
    score,
    source::{self, CaptureSettings, Disturbed},
    surface,
};
use picofarm_results::Verdict;
use picofarm_scene::{Camera, Scene, plato};
use picofarm_settings::{Jitter, Pulse, Scale, Sensor};
use picofarm_tasks::{Memory, reconstruct};
use picofarm_transient::RenderError;
use serde_json::{Value, json};

use self::{watch::Watch, written::write};
use crate::{
    args::{FieldArg, Reconstruct, SpotsFrom, ViewsArg},
    error::{CliError, Code, Result},
    output::{Output, duration, files::free_folder},
    signals,
};

/// Width and height of a novel view, in pixels.
const VIEW_SIDE: u32 = 128;
/// Number of novel views on the circle, before those inside an object are removed.
const AROUND: usize = 24;

/// The result, and the time of each part.
struct Made {
    reconstructed: Reconstructed,
    mesh: Surface,
    glb: Vec<u8>,
    metrics: Value,
    views: Canvas,
    orbit: Vec<u8>,
    seconds: [f64; 3],
}

/// `reconstruct`.
///
/// # Errors
/// Fails on an unusable scene or argument, too little memory, a folder in use, or an interruption.
pub async fn run(args: Reconstruct, output: Output) -> Result<()> {
    mlp::check(&args)?;
    free_folder(&args.out)?;
    if args.file.is_dir() {
        return folder::run(args, output).await;
    }
    check_networks(&args)?;
    let size = Some(args.resolution).filter(|size| !size.is_square());
    let mut scene = args.input.read_sized(&args.file, size)?;
    // A square shows the whole view of the camera.
    if size.is_none() {
        let i = &mut scene.camera.intrinsics;
        *i = i.resized(args.resolution.width, args.resolution.height);
    }
    if scene.laser.beams.is_empty() {
        let what = format!("{}: the scene has no laser beam", args.file.display());
        return Err(CliError::input(what).hint(
            "picofarm scene export --spots 16 gives it beams; see docs/scene-files.md for laser_directions",
        ));
    }
    let networks = match args.source() {
        SpotsFrom::Predictions => Some(predicted::read(&args, scene.laser.beams.len()).await?),
        SpotsFrom::Captures | SpotsFrom::Truth | SpotsFrom::Flash => None,
    };
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            CliError::new(
                Code::Resource,
                format!("cannot start {threads} threads: {e}"),
            )
        })?;
    let watch = Watch::new(output, signals::stop_on_signal()?);
    let (args, watch, made) = tokio::task::spawn_blocking(move || {
        let made = pool.install(|| make(&args, &scene, networks.as_ref(), threads, &watch));
        (args, watch, made)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the reconstruction broke: {e}")))?;
    watch.finish();
    let made = made?;
    write(&args.out, &made)?;
    let [measuring, fitting, scoring] = made.seconds;
    let mut shown = made.metrics.clone();
    shown["out"] = json!(args.out);
    shown["threads"] = json!(threads);
    shown["verdict"] = json!(Verdict::of_reconstruction(&made.metrics));
    shown["seconds"] =
        json!({"measurements": measuring, "reconstruction": fitting, "metrics": scoring});
    output.result(&shown, || summary(&args, &made));
    Ok(())
}

/// Rejects a grid that does not fit into memory, before anything is rendered for it.
fn check_memory(args: &Reconstruct, scene: &Scene, nodes: u32) -> Result<()> {
    let i = &scene.camera.intrinsics;
    let shape = Shape {
        height: i.height,
        width: i.width,
        bins: args.gate.bins,
        spots: scene.laser.beams.len() as u32,
    };
    let needed = grid_bytes(nodes, &shape);
    match Memory::here() {
        Some(there) if needed > there.for_tasks_mib() << 20 => Err(CliError::new(
            Code::Resource,
            format!(
                "--nodes {nodes}, --resolution {}: the reconstruction takes about {} of memory, but there is {there}; choose \
                 fewer nodes or pixels",
                args.resolution,
                gib(needed)
            ),
        )),
        _ => Ok(()),
    }
}

fn make(
    args: &Reconstruct,
    scene: &Scene,
    networks: Option<&predicted::Networks>,
    threads: usize,
    watch: &Watch,
) -> Result<Made> {
    check_memory(args, scene, grid_settings(args).nodes)?;
    let start = Instant::now();
    let (measured, separated) = measure(args, scene, networks, threads, watch)?;
    let lap = |since: Instant| since.elapsed().as_secs_f64();
    let measuring = lap(start);
    let settings = grid_settings(args);
    let start = Instant::now();
    let (reconstructed, networks) = match args.field {
        FieldArg::Grid => (fit(measured, settings, watch)?, None),
        FieldArg::Mlp => {
            let (made, settings) = mlp::fit(args, measured, settings, watch)?;
            (made, Some(settings))
        }
    };
    let fitting = lap(start);
    let start = Instant::now();
    watch.step("errors", 0.0);
    let mesh = surface(&reconstructed.field);
    let world = World::new(scene);
    let views = match args.views {
        ViewsArg::Plato => plato::views(VIEW_SIDE),
        ViewsArg::Around => score::around(
            &reconstructed.measured,
            &reconstructed.depth.range,
            &world,
            AROUND,
            VIEW_SIDE,
        ),
    };
    let mut metrics = metrics(
        args,
        scene,
        &settings,
        (&reconstructed, &mesh),
        (&world, &views),
    )?;
    if let Some(settings) = networks {
        metrics["mlp"] = settings;
    }
    if let Some((how, facts)) = separated {
        metrics[how] = facts;
    }
    let scoring = lap(start);
    watch.step("pictures", 0.0);
    Ok(Made {
        views: reconstruct::views(&reconstructed, &world, &views),
        orbit: orbit::orbit(&reconstructed, &views),
        glb: mesh.glb(&reconstructed.measured).map_err(refused)?,
        reconstructed,
        mesh,
        metrics,
        seconds: [measuring, fitting, scoring],
    })
}

/// The settings of the grid.
fn grid_settings(args: &Reconstruct) -> Settings {
    Settings {
        nodes: if args.fine {
            Settings::FINE_NODES
        } else {
            args.nodes
        },
        planes: !args.no_planes && args.field == FieldArg::Grid,
        // Networks use the grid's box and evidence, but learn from shadows themselves.
        shadows: match args.field {
            FieldArg::Grid => Settings::default().shadows,
            FieldArg::Mlp => Shadows::Carve,
        },
        seed: args.seed,
        accept_inconsistent: args.accept_inconsistent,
        ..Settings::default()
    }
}

/// Fits the grid.
fn fit(measured: Measured, settings: Settings, watch: &Watch) -> Result<Reconstructed> {
    let mut reconstruction = Reconstruction::begin(measured, settings, watch).map_err(refused)?;
    match reconstruction.run(watch).map_err(refused)? {
        true => Ok(reconstruction.finish()),
        false => Err(signals::interrupted("nothing was written")),
    }
}

/// Returns times and masks, and the quality of those that were separated from one flash, if any,
/// with their name in metrics.json.
fn measure(
    args: &Reconstruct,
    scene: &Scene,
    networks: Option<&predicted::Networks>,
    threads: usize,
    watch: &Watch,
) -> Result<(Measured, Option<(&'static str, Value)>)> {
    if let Some(networks) = networks {
        let (measured, facts) = predicted::measure(args, scene, networks, threads, watch)?;
        return Ok((measured, Some(("predictions", facts))));
    }
    if args.source() == SpotsFrom::Flash {
        let (measured, facts) = flash::measure(args, scene, threads, watch)?;
        return Ok((measured, Some(("flash", facts))));
    }
    if args.source() == SpotsFrom::Truth {
        watch.step("ground truth", 0.0);
        let rendered = source::truth_of(scene, watch).map_err(refused)?;
        let measured = source::from_truth(scene, &rendered, &Disturbed::default());
        return Ok((measured.map_err(refused)?, None));
    }
    let settings = CaptureSettings {
        gate: args.gate.gate(),
        samples: args.samples,
        seed: args.seed,
        sensor: sensor(args),
    };
    fits_memory(&settings, scene, threads)?;
    let captures = scene.laser.beams.len();
    let progress = |capture: usize, done: f32| {
        let share = (capture as f32 + done) / captures as f32;
        watch.step(&format!("capture {} of {captures}", capture + 1), share)
    };
    let measured = source::captures_of(scene, &settings, &progress).map_err(refused)?;
    Ok((measured, None))
}

/// Returns the detector for captures: photon noise and ambient light, with an ideal pulse.
fn sensor(args: &Reconstruct) -> Option<Sensor> {
    args.detector.photons.map(|photons| Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        scale: Scale::Peak { photons },
        dark_per_bin: args.detector.ambient.unwrap_or(0.0),
        ..Sensor::default()
    })
}

/// Rejects a render that does not fit into memory.
fn fits_memory(settings: &CaptureSettings, scene: &Scene, threads: usize) -> Result<()> {
    let size = picofarm_tasks::scene_size(scene);
    picofarm_tasks::check_memory(&settings.render_settings(), size, threads)
        .map_err(|e| CliError::new(Code::Resource, e))
}

/// Rejects options for predictions if times have another source.
fn check_networks(args: &Reconstruct) -> Result<()> {
    let given = &args.networks;
    if args.source() != SpotsFrom::Captures && args.detector.photons.is_some() {
        let what = "--photons belongs to --spots-from captures";
        return Err(CliError::input(what).hint("add --spots-from captures, or leave it out"));
    }
    if args.source() == SpotsFrom::Predictions {
        return Ok(());
    }
    for (option, value) in [
        ("--models", &given.models),
        ("--tof", &given.tof),
        ("--shadow", &given.shadow),
        ("--specular", &given.specular),
    ] {
        if value.is_some() {
            let what = format!("{option} belongs to --spots-from predictions");
            return Err(CliError::input(what).hint("add --spots-from predictions, or leave it out"));
        }
    }
    Ok(())
}

fn refused(e: ReconstructError) -> CliError {
    match e {
        ReconstructError::Stopped | ReconstructError::Render(RenderError::Stopped) => {
            signals::interrupted("nothing was written")
        }
        ReconstructError::Render(RenderError::Memory { .. }) => CliError::new(Code::Resource, e),
        e @ ReconstructError::Inconsistent { .. } => CliError::input(e).hint(
            "correct the scene, the gate or the predictions; --accept-inconsistent goes on all the same",
        ),
        e => CliError::input(e),
    }
}

/// Returns the contents of metrics.json. They contain no run times, so that the same scene and
/// arguments give the same bytes.
fn metrics(
    args: &Reconstruct,
    scene: &Scene,
    settings: &Settings,
    (made, mesh): (&Reconstructed, &Surface),
    (world, views): (&World, &[Camera]),
) -> Result<Value> {
    let mut all = reconstruct::facts(made, mesh);
    all.extend(reconstruct::errors(made, mesh, world, views, args.seed).map_err(refused)?);
    let asked = json!({
        "scene": scene.name,
        "provenance": scene.provenance,
        "spots_from": args.source().name(),
        "resolution": args.resolution,
        "settings": settings,
        "views": match args.views { ViewsArg::Around => "around", ViewsArg::Plato => "plato" },
    });
    all.extend(asked.as_object().cloned().unwrap_or_default());
    if let Some(sensor) = sensor(args) {
        all.insert("sensor".into(), json!(sensor));
    }
    Ok(Value::Object(all))
}

fn summary(args: &Reconstruct, made: &Made) -> String {
    let m = &made.metrics["novel_views"];
    let l1 = |of: &str| m[of]["l1_m"].as_f64().unwrap_or(0.0);
    let mut text = format!(
        "{}: novel views: L1 {:.4} m over {} views (visible {:.4}, occluded {:.4}, outside the view {:.4}), PSNR {:.1} dB\n",
        args.out.display(),
        l1("all"),
        m["views"],
        l1("visible"),
        l1("occluded"),
        l1("outside"),
        m["psnr_db"].as_f64().unwrap_or(0.0),
    );
    if let Some(chamfer) = made.metrics["mesh"]["chamfer_m"].as_f64() {
        let f = made.metrics["mesh"]["f_score"].as_f64().unwrap_or(0.0);
        let floating = made.metrics["floaters"]["volume_m3"]
            .as_f64()
            .unwrap_or(0.0);
        text += &format!(
            "  mesh: {} triangles, Chamfer {chamfer:.4} m, F-score {f:.3} at 5 cm; floating matter {floating:.4} m3\n",
            made.mesh.triangles.len()
        );
    }
    let [measuring, fitting, scoring] = made.seconds.map(duration);
    text += &format!("  measurements {measuring}, reconstruction {fitting}, errors {scoring}\n");
    let verdict = Verdict::of_reconstruction(&made.metrics);
    text += &format!("  verdict: {}\n", verdict.text);
    for note in &made.reconstructed.notes {
        text += &format!("  note: {note}\n");
    }
    text
}
