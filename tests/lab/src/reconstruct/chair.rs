//! Measures the figures of docs/benchmarks.md on the networks: CPU-seconds of a step, and L1 of
//! novel views against CPU-seconds.
//!
//! `just lab chair step` measures a step of each
//! stage at full size, and at smaller ones.
//! `-- curve WIDTH BATCH COARSE FINE DISTANCE_STEPS SHADOW_STEPS squares|cross_entropy` fits
//! PlatoNeRF's room with a chair, from times and shadows of its truth at 512 pixels in bins of 128
//! ps, and prints the errors at each quarter of the work. `-- grid` prints those of the grid in the
//! same views. `-- memory WIDTH` prints the memory of a step of stage 2.

use std::error::Error;

use picofarm_platonerf::{Settings, ShadowLoss, Training};
use picofarm_reconstruct::{
    Measured, Phase, Progress, Reconstructed, Reconstruction, Shadows, Unwatched, World,
    reconstruct,
    render::{Distances, Renderer},
    score::score_views,
    source::{Disturbed, from_truth, truth_of},
};
use picofarm_scene::{
    Camera, Scene,
    plato::{self, PlatoSettings},
};
use rustix::time::{ClockId, clock_gettime};

/// The width of a bin of 128 ps, metres.
const BIN_M: f32 = 0.0384;
/// The number of nodes of the grid on which densities are sampled.
const NODES: u32 = 128;
/// The number of pixels along a side of a novel view through the network, and the distance between
/// the views that are used.
const SIDE: u32 = 48;
const EVERY: usize = 14;

struct Unstopped;

impl picofarm_transient::Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// Stops at a share of the work.
struct Until(f32);

impl Progress for Until {
    fn at(&self, _: Phase, done: f32, _: Option<f64>) -> bool {
        done < self.0
    }
}

/// Prints the figures that `words` select.
///
/// # Errors
/// Fails on words that are no measurement, or if the room cannot be reconstructed.
pub fn run(words: &[String]) -> Result<(), Box<dyn Error>> {
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let scene = plato::generate(&PlatoSettings::default())?;
    let how = Disturbed {
        bin_width_m: BIN_M,
        ..Disturbed::default()
    };
    let measured = from_truth(&scene, &truth_of(&scene, &Unstopped)?, &how)?;
    match words.as_slice() {
        ["step"] => steps(&measured),
        ["grid"] => grid(&scene, &measured),
        ["memory", width] => memory(&measured, width.parse()?),
        ["curve", width, batch, coarse, fine, distance, shadow, how] => {
            let settings = Settings {
                width: width.parse()?,
                batch: batch.parse()?,
                coarse: coarse.parse()?,
                fine: fine.parse()?,
                distance_steps: distance.parse()?,
                shadow_steps: shadow.parse()?,
                shadow_loss: match *how {
                    "cross_entropy" => ShadowLoss::CrossEntropy,
                    _ => ShadowLoss::Squares,
                },
                ..Settings::default()
            };
            curve(&scene, measured, settings)
        }
        _ => Err(
            "expected: step, grid, memory WIDTH, or curve WIDTH BATCH COARSE FINE DISTANCE_STEPS SHADOW_STEPS squares|cross_entropy".into(),
        ),
    }
}

fn cpu_seconds() -> f64 {
    let t = clock_gettime(ClockId::ProcessCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

/// Prints the peak memory of one step of stage 2 in addition to the measurements, MiB.
fn memory(measured: &Measured, width: usize) -> Result<(), Box<dyn Error>> {
    let peak = || -> Result<f64, Box<dyn Error>> {
        let status = std::fs::read_to_string("/proc/self/status")?;
        let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
        let kib = line.and_then(|l| l.split_whitespace().next());
        Ok(kib.ok_or("no VmHWM in /proc/self/status")?.parse::<f64>()? / 1024.0)
    };
    let settings = Settings {
        width,
        distance_steps: 0,
        shadow_steps: 1,
        ..Settings::default()
    };
    // Resets the peak of earlier memory use.
    std::fs::write("/proc/self/clear_refs", "5")?;
    let mut training = Training::begin(measured.clone(), settings)?;
    let before = peak()?;
    training.run(&Unwatched)?;
    println!("width {width}: {:.0} MiB", peak()? - before);
    Ok(())
}

/// Prints CPU-seconds and seconds of a step of each stage.
fn steps(measured: &Measured) -> Result<(), Box<dyn Error>> {
    println!("width | rays | samples | stage | CPU s a step | s a step");
    let full = Settings::default();
    let sized = |width, batch, coarse, fine| Settings {
        width,
        batch,
        coarse,
        fine,
        ..full
    };
    for (settings, count) in [
        (sized(64, 256, 32, 32), 8),
        (sized(128, 256, 32, 64), 4),
        (full, 1),
    ] {
        for (stage, distance_steps, shadow_steps) in [(1, count, 0), (2, 0, count)] {
            let s = Settings {
                distance_steps,
                shadow_steps,
                ..settings
            };
            let mut training = Training::begin(measured.clone(), s)?;
            let (cpu, wall) = (cpu_seconds(), std::time::Instant::now());
            training.run(&Unwatched)?;
            let each = |seconds: f64| seconds / f64::from(count);
            println!(
                "{} | {} | {} + {} | {stage} | {:.3} | {:.3}",
                s.width,
                s.batch,
                s.coarse,
                s.fine,
                each(cpu_seconds() - cpu),
                each(wall.elapsed().as_secs_f64()),
            );
        }
    }
    Ok(())
}

/// Prints the errors at quarters of a fit.
fn curve(scene: &Scene, measured: Measured, settings: Settings) -> Result<(), Box<dyn Error>> {
    let grid = picofarm_reconstruct::Settings {
        nodes: NODES,
        planes: false,
        shadows: Shadows::Carve,
        ..picofarm_reconstruct::Settings::default()
    };
    let start = Reconstruction::begin(measured.clone(), grid, &Unwatched)?.finish();
    let views = Views::new(scene);
    let own = Views::measuring(scene);
    println!(
        "{settings:?}\nmethod | steps | loss | L1 m | visible | occluded | outside | within view | CPU s"
    );
    let mut training = Training::begin(measured, settings)?;
    let mut seconds = 0.0;
    for quarter in [0.125, 0.25, 0.5, 0.75, 2.0] {
        let cpu = cpu_seconds();
        training.run(&Until(quarter))?;
        seconds += cpu_seconds() - cpu;
        let fitted = training.fitted();
        let field = fitted.sampled(&start.field);
        let made = Reconstructed {
            field,
            ..start.clone()
        };
        let after = format!("{} | {:.3}", training.state().step, training.state().loss);
        own.say("networks, the measuring view", &after, &fitted, seconds);
        views.say("networks", &after, &fitted, seconds);
        views.say(
            "networks on a grid",
            &after,
            &Renderer::new(&made.field),
            seconds,
        );
    }
    Ok(())
}

/// The reference for comparing fields.
struct Views<'a> {
    scene: &'a Scene,
    world: World,
    cameras: Vec<Camera>,
}

impl<'a> Views<'a> {
    fn new(scene: &'a Scene) -> Self {
        Self {
            scene,
            world: World::new(scene),
            cameras: plato::views(SIDE).into_iter().step_by(EVERY).collect(),
        }
    }

    fn measuring(scene: &'a Scene) -> Self {
        let intrinsics = scene.camera.intrinsics.resized(SIDE, SIDE);
        Self {
            cameras: vec![Camera {
                intrinsics,
                ..scene.camera
            }],
            ..Self::new(scene)
        }
    }

    /// Prints a line of the table.
    fn say(&self, name: &str, after: &str, of: &dyn Distances, seconds: f64) {
        let s = score_views(of, &self.scene.camera, &self.world, &self.cameras);
        let l1 = [s.all, s.visible, s.occluded, s.outside, s.within_view].map(|x| x.l1_m);
        let [all, visible, occluded, outside, within] = l1;
        println!(
            "{name} | {after} | {all:.4} | {visible:.4} | {occluded:.4} | {outside:.4} | {within:.4} | {seconds:.1}"
        );
    }
}

/// Prints the errors of the grid, with and without planes of the room.
fn grid(scene: &Scene, measured: &Measured) -> Result<(), Box<dyn Error>> {
    let views = Views::new(scene);
    for planes in [true, false] {
        let settings = picofarm_reconstruct::Settings {
            nodes: NODES,
            planes,
            ..picofarm_reconstruct::Settings::default()
        };
        let cpu = cpu_seconds();
        let made = reconstruct(measured.clone(), settings, &Unwatched)?;
        let seconds = cpu_seconds() - cpu;
        let name = if planes {
            "grid"
        } else {
            "grid, without planes"
        };
        views.say(name, "100 |", &Renderer::new(&made.field), seconds);
    }
    Ok(())
}
