//! `picofarm scene render` and `picofarm scene plan`: one scene file on this machine, without a
//! farm.

use std::{
    path::Path,
    sync::{
        Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Instant,
};

use picofarm_agent::SceneSize;
use picofarm_dataset::{RenderArray, write_render_group};
use picofarm_proto::{
    model::{RenderSettings, memory::gib},
    show,
};
use picofarm_scene::{
    Scene,
    import::{self, ImportOptions},
};
use picofarm_transient::{
    Budget, ClassVariance, Forecast, Progress, RenderError, Rendered, Settings, Wavelength,
};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::{
    args::{RenderArgs, ScenePlan, SceneRender},
    choices,
    error::{CliError, Code, Result, io},
    groups::{self, Wanted},
    output::{Meter, Output, duration},
    roles, signals,
};

/// Shows progress. A cancelled token stops the render.
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

/// Maximum samples of a render that only time limits: more than any render reaches.
const MOST_SAMPLES: u32 = 1 << 20;

/// A scene and its render settings.
struct Order {
    scene: Scene,
    settings: Settings,
    wanted: Vec<Wanted>,
    threads: usize,
}

impl Order {
    /// Reads the scene and checks the arguments against it.
    fn new(args: &RenderArgs, split: bool) -> Result<Self> {
        let mut scene =
            import::read_scene_with(&args.file, &ImportOptions::default(), &args.root.bounds())?;
        let samples = args.samples.unwrap_or(64);
        let asked = RenderSettings {
            resolution: args.resolution.unwrap_or(RenderSettings::MAX_SIDE),
            gate_start_m: args.gate.gate_start_m,
            bin_width_m: args.gate.bin_width_m,
            bins: args.gate.bins,
            budget: match args.error {
                Some(e) => Budget::Error(e),
                None => Budget::Samples(samples),
            },
            max_bounces: args.max_bounces.unwrap_or(0),
            beam: args.beam.width(),
            fill_factor: args.fill_factor.unwrap_or(1.0),
            wavelengths_nm: Wavelength::of(&args.wavelengths_nm)
                .map_err(|(at, what)| CliError::input(format!("--wavelengths-nm{at}: {what}")))?,
            ..RenderSettings::default()
        };
        // Checked as in a job, so that the ranges are defined in one place.
        asked.check().map_err(|e| {
            let option = e.field.trim_start_matches("render.");
            let option = option.replace(['_', '.'], "-");
            CliError::input(format!("--{option}: {}", e.what))
        })?;
        if let Some(px) = args.resolution {
            let i = &mut scene.camera.intrinsics;
            *i = i.resized(px, px);
        }
        let wanted = groups::wanted(&args.groups, &args.group, scene.laser.beams.len())?;
        let settings = Settings {
            gate: asked.gate(),
            budget: asked.budget,
            max_bounces: args.max_bounces.filter(|most| *most != 0),
            one_bounce: true,
            seed: args.seed,
            split,
            groups: wanted.iter().flat_map(|w| w.groups.clone()).collect(),
            strategy: choices::together(&args.strategy)?,
            beam: asked.beam,
            fill_factor: asked.fill_factor,
            wavelengths_nm: asked.wavelengths_nm,
        };
        Ok(Self {
            scene,
            settings,
            wanted,
            threads: args.threads.unwrap_or_else(roles::cores).max(1),
        })
    }

    fn pool(&self) -> Result<rayon::ThreadPool> {
        let threads = self.threads;
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|e| {
                let what = format!("cannot start {threads} threads: {e}");
                CliError::new(Code::Resource, what)
            })
    }

    fn size(&self) -> SceneSize {
        picofarm_agent::scene_size(&self.scene)
    }

    /// Returns the maximum memory of the render, in bytes.
    fn memory(&self) -> u64 {
        picofarm_agent::render_bytes(&self.settings, self.size(), self.threads)
    }

    /// Checks that this memory is available.
    fn fits(&self) -> Result<(), String> {
        picofarm_agent::check_memory(&self.settings, self.size(), self.threads)
    }
}

/// `scene render`.
///
/// # Errors
/// Fails on an unusable scene or argument, too little memory, a folder in use, or an interruption.
pub async fn render(args: SceneRender, output: Output) -> Result<()> {
    free_folder(&args.out)?;
    let mut order = Order::new(&args.render, args.split)?;
    if args.seconds.is_some() && args.render.error.is_none() && args.render.samples.is_none() {
        // Only time limits the render.
        order.settings.budget = Budget::Samples(MOST_SAMPLES);
    }
    order.fits().map_err(|e| CliError::new(Code::Resource, e))?;
    let watcher = Watcher {
        done: AtomicU32::new(0),
        meter: Mutex::new(Meter::new(output)),
        stop: signals::stop_on_signal()?,
    };
    let pool = order.pool()?;
    let start = Instant::now();
    let (mut order, watcher, rendered) = tokio::task::spawn_blocking(move || {
        let run = || match args.seconds {
            None => picofarm_transient::render(&order.scene, &order.settings, &watcher),
            Some(seconds) => {
                let left = || seconds - start.elapsed().as_secs_f64();
                picofarm_transient::render_within(&order.scene, &order.settings, &left, &watcher)
            }
        };
        let rendered = pool.install(run);
        (order, watcher, rendered)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the renderer broke: {e}")))?;
    if let Ok(meter) = watcher.meter.into_inner() {
        meter.finish();
    }
    let mut rendered = rendered.map_err(|e| match e {
        RenderError::Stopped => signals::interrupted("nothing was written"),
        RenderError::Memory { .. } => CliError::new(Code::Resource, e),
        e => CliError::input(e),
    })?;
    let seconds = start.elapsed().as_secs_f64();
    let beside = beside(&mut rendered, &order);
    if args.seconds.is_some() {
        // Records the samples actually used, so that the render can be repeated.
        order.settings.budget = Budget::Samples(rendered.error.samples);
    }
    write(&args.out, &order, &rendered, &beside)?;
    let (e, threads) = (&rendered.error, order.threads);
    let arrays: Vec<&str> = order.wanted.iter().map(|w| w.array.as_str()).collect();
    output.result(
        &json!({
            "out": args.out, "seconds": seconds, "threads": threads, "rays": rendered.rays,
            "error": e, "overflow": rendered.overflow, "plan": rendered.plan, "subsets": arrays,
            "warnings": rendered.warnings,
        }),
        || {
            let mut text = format!(
                "{}: {} paths a pixel, median error {:.2} %, total {:.2} %, {} on {threads} thread(s), {:.1} M rays\n",
                args.out.display(), e.samples, e.median_relative * 100.0, e.total_relative * 100.0,
                duration(seconds), rendered.rays as f64 / 1e6,
            );
            if !arrays.is_empty() {
                text += &format!("  also {}\n", arrays.join(", "));
            }
            text + &noted(&order.scene) + &decided(&rendered.plan) + &warned(&rendered.warnings)
        },
    );
    Ok(())
}

/// `scene plan`.
///
/// # Errors
/// Fails on an unusable scene or argument.
pub async fn plan(args: ScenePlan, output: Output) -> Result<()> {
    let order = Order::new(&args.render, false)?;
    let memory = order.memory();
    if let Err(what) = order.fits() {
        return too_large(&order, memory, &what, output);
    }
    let pool = order.pool()?;
    let by_class = args.variance;
    let (order, found) = tokio::task::spawn_blocking(move || {
        let run = || {
            let forecast = picofarm_transient::plan(&order.scene, &order.settings)?;
            let classes = match by_class {
                true => picofarm_transient::variance(&order.scene, &order.settings, PASSES)?,
                false => Vec::new(),
            };
            Ok((forecast, classes))
        };
        let found: std::result::Result<_, RenderError> = pool.install(run);
        (order, found)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the renderer broke: {e}")))?;
    let (forecast, classes) = found.map_err(CliError::input)?;
    let Forecast {
        plan,
        passes,
        error,
        rays,
        warnings,
    } = &forecast;
    let i = &order.scene.camera.intrinsics;
    let mut facts = json!({
        "scene": order.scene.name, "width": i.width, "height": i.height,
        "spots": order.scene.laser.beams.len(), "gate": order.settings.gate,
        "strategies": plan.strategies, "approximations": plan.approximations,
        "samples": passes, "error": error, "rays": rays, "memory_bytes": memory, "fits": true,
        "warnings": warnings,
    });
    if by_class {
        let share = |c: &ClassVariance| {
            json!({
                "paths": c.class, "energy": c.energy, "variance": c.variance, "of_the_middle_half": c.middle,
            })
        };
        facts["variance"] = classes.iter().map(share).collect();
    }
    output.result(
        &facts,
        || {
            let head = format!(
                "{}: {}x{} pixels x {} bins, {} spots\n\
                 about {passes} paths a pixel, median error {:.1} %, {:.1} M rays, about {} of memory\n",
                show::line(&order.scene.name),
                i.width,
                i.height,
                order.settings.gate.bins,
                order.scene.laser.beams.len(),
                error * 100.0,
                *rays as f64 / 1e6,
                gib(memory),
            );
            head + &noted(&order.scene)
                + &decided(plan)
                + &carried(by_class, &classes)
                + &warned(warnings)
        },
    );
    Ok(())
}

/// Number of passes for estimating the variance of path classes.
const PASSES: u32 = 64;

/// Formats the variance by path class as a table.
fn carried(asked: bool, classes: &[ClassVariance]) -> String {
    if !asked {
        return String::new();
    }
    if classes.is_empty() {
        return "no paths of three bounces and more\n".to_owned();
    }
    let mut text = "paths of three bounces and more, and of two where they are drawn into the image: % of energy, of variance, and of the variance of the middle\n\
         half of the pixels:\n"
        .to_owned();
    for c in classes {
        let [energy, variance, middle] = [c.energy, c.variance, c.middle].map(|x| 100.0 * x);
        text += &format!(
            "  {energy:6.2}  {variance:6.2}  {middle:6.2}  {}\n",
            c.class
        );
    }
    text
}

/// Prints the plan of a render that does not fit into memory. Nothing is measured for it.
fn too_large(order: &Order, memory: u64, what: &str, output: Output) -> Result<()> {
    let ((width, height), _) = order.size();
    output.result(
        &json!({
            "scene": order.scene.name, "width": width, "height": height,
            "spots": order.scene.laser.beams.len(), "gate": order.settings.gate,
            "memory_bytes": memory, "fits": false,
        }),
        || format!("{}: does not fit: {what}\n", show::line(&order.scene.name)),
    );
    Ok(())
}

/// Formats the renderer's decisions, one per line.
fn decided(plan: &picofarm_transient::Plan) -> String {
    let strategies = plan.strategies.iter().map(|line| format!("  {line}\n"));
    let approximations = plan.approximations.iter();
    strategies
        .chain(approximations.map(|line| format!("  approximated: {line}\n")))
        .collect()
}

/// Returns a line for each change or omission made while the scene was read.
fn noted(scene: &Scene) -> String {
    let notes = scene.provenance.notes.iter();
    let read = notes.filter_map(|(key, note)| Some((key.strip_prefix("import.")?, note)));
    read.map(|(key, note)| show::line(&format!("note: {key}: {note}")).to_string() + "\n")
        .collect()
}

fn warned(warnings: &[String]) -> String {
    let lines = warnings.iter().map(|line| format!("warning: {line}\n"));
    lines.collect()
}

/// Rejects early a folder that the writer would reject after the render.
///
/// # Errors
/// Fails if the folder is not empty, or cannot be read.
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

/// A histogram in addition to the main one.
struct Beside {
    array: String,
    per_spot: bool,
    data: Vec<f32>,
}

/// Takes the groups out of the render, one run of values for each array. Each group is let go as
/// soon as it is copied, so that histograms of a hundred spots never lie in memory twice.
fn beside(rendered: &mut Rendered, order: &Order) -> Vec<Beside> {
    let one = rendered.transient.len();
    let mut groups = std::mem::take(&mut rendered.groups).into_iter();
    let join = move |wanted: &Wanted| Beside {
        array: wanted.array.clone(),
        per_spot: wanted.per_spot,
        data: if wanted.per_spot {
            let count = wanted.groups.len();
            let mut all = Vec::with_capacity(count * one);
            groups.by_ref().take(count).for_each(|g| all.extend(g));
            all
        } else {
            groups.next().unwrap_or_default()
        },
    };
    order.wanted.iter().map(join).collect()
}

fn write(out: &Path, order: &Order, r: &Rendered, beside: &[Beside]) -> Result<()> {
    let Order {
        scene,
        settings,
        wanted,
        ..
    } = order;
    let (h, w, b) = (
        u64::from(r.height),
        u64::from(r.width),
        u64::from(r.gate.bins),
    );
    let cube = [h, w, b];
    let each = [scene.laser.beams.len() as u64, h, w, b];
    let histogram = |name, data| RenderArray {
        name,
        shape: &cube,
        dimension_names: &["row", "column", "bin"],
        data,
    };
    let masks = [scene.laser.beams.len() as u64, h, w];
    let flags = |all: &[u8]| all.iter().map(|x| f32::from(*x)).collect::<Vec<_>>();
    let (specular, visibility) = (flags(&r.truth.specular), flags(&r.truth.visibility));
    let mut arrays = vec![
        histogram("transient", &r.transient),
        RenderArray {
            name: "depth",
            shape: &cube[..2],
            dimension_names: &["row", "column"],
            data: &r.truth.depth,
        },
        RenderArray {
            name: "specular",
            shape: &cube[..2],
            dimension_names: &["row", "column"],
            data: &specular,
        },
    ];
    if !visibility.is_empty() {
        arrays.push(RenderArray {
            name: "visibility",
            shape: &masks,
            dimension_names: &["spot", "row", "column"],
            data: &visibility,
        });
    }
    for b in beside {
        arrays.push(match b.per_spot {
            false => histogram(&b.array, &b.data),
            true => RenderArray {
                name: &b.array,
                shape: &each,
                dimension_names: &["spot", "row", "column", "bin"],
                data: &b.data,
            },
        });
    }
    if let Some(s) = &r.split {
        arrays.extend([
            histogram("two", &s.two),
            histogram("two_se", &s.two_se),
            histogram("two_noise", &s.two_noise),
            histogram("multi", &s.multi),
            histogram("multi_se", &s.multi_se),
            histogram("multi_noise", &s.multi_noise),
        ]);
    }
    let beams: serde_json::Map<_, _> = wanted
        .iter()
        .map(|w| (w.array.clone(), json!(w.groups.concat())))
        .collect();
    let arrays_of_all = beside.iter().map(|b| b.array.clone());
    let wavelengths: serde_json::Map<_, _> = settings
        .wavelengths_nm
        .nm()
        .into_iter()
        .flat_map(|nm| {
            let names = ["transient".to_owned()].into_iter();
            names
                .chain(arrays_of_all.clone())
                .map(move |name| (name, json!(nm)))
        })
        .collect();
    let mut attributes = json!({
        "scene": scene.name,
        "provenance": scene.provenance,
        "value": "radiance reaching the pixel per unit pulse energy, averaged over its footprint, integrated over the bin; 1/(m2 sr)",
        "transient": "all bounces; two: exactly two; multi: three and more; *_se: standard errors; two_noise, multi_noise: draws of the errors of two and multi; the square of their sum over any pixels and bins estimates that sum's variance",
        "specular": "1 where the first surface is a mirror",
        "visibility": "1 where the spot of a beam lights what a pixel's middle sees",
        "subsets": beams,
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
    if !wavelengths.is_empty() {
        attributes["wavelengths_nm"] = json!(wavelengths);
    }
    let attributes = attributes.as_object().expect("written as an object");
    for array in arrays
        .iter()
        .filter(|array| array.dimension_names.contains(&"bin"))
    {
        if let Some(at) = array.data.iter().position(|x| !x.is_finite()) {
            let (x, bins) = (array.data[at], r.gate.bins as usize);
            let what = format!(
                "scene {:?}: {} is {x} at pixel {}, bin {}; nothing was written",
                scene.name,
                array.name,
                at / bins,
                at % bins
            );
            return Err(CliError::new(Code::Failed, what).hint(
                "the renderer is at fault: report it with the scene, or try another --seed",
            ));
        }
    }
    write_render_group(out, &arrays, attributes).map_err(|e| CliError::new(Code::Resource, e))
}
