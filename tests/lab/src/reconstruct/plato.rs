//! Measures the figures of docs/benchmarks.md: L1 of novel views against CPU-seconds.
//!
//! `just lab plato` measures PlatoNeRF's room with our
//! own furniture, from times and shadows of its truth in bins of 128 ps. Further words select:
//! `captures` (times and shadows from rendered histograms, an hour), `ambient` (photon noise and
//! ambient light in them), `peers` (other methods), `sampling` (bins, pixels and grids of spots),
//! `rooms` (unseen primitive and furnished rooms; with `captures`, half an hour), `quick` (every
//! seventh view), `=TEXT` (rows with a name that contains the text).

use std::error::Error;

use picofarm_reconstruct::{
    Measured, ReconstructError, Settings, Shadows, Unwatched, World,
    baseline::{Behind, bounce_flash, depth_alone},
    field::Field,
    reconstruct,
    render::Renderer,
    score::{ViewScore, around, floaters, mesh_score, score_views},
    source::{
        CaptureSettings, Captures, Disturbed, LIT_THRESHOLD, captures_of, from_truth, truth_of,
    },
    surface,
};
use picofarm_scene::{
    Aim, AssetLibrary, Scene,
    furnished::{self, FurnishedSettings},
    plato::{self, PlatoObject, PlatoSettings},
    primitive::{self, PrimitiveSettings},
};
use picofarm_settings::{Jitter, Pulse, Scale, Sensor};
use picofarm_transient::{Gate, Progress, render};
use rustix::time::{ClockId, clock_gettime};

/// The width of a bin of 128 ps, metres.
const BIN_M: f32 = 0.0384;
/// The number of pixels along a side of a novel view.
const SIDE: u32 = 128;
/// The number of unseen rooms of each kind.
const ROOMS: u64 = 8;

struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// One line of the table.
#[derive(Clone, Copy)]
struct Row {
    name: &'static str,
    room: PlatoSettings,
    how: Disturbed,
    settings: Settings,
    captures: bool,
    /// The spots of a regular grid over the image, as in multiplexed captures; 0 = the room's own.
    grid: u32,
    /// The method that computes the field.
    method: Method,
}

/// A method that computes a field from measurements.
#[derive(Clone, Copy)]
enum Method {
    /// This crate's method.
    Grid,
    BounceFlash,
    DepthAlone(Behind),
}

/// Prints the rows that `words` select.
///
/// # Errors
/// Fails if a room cannot be rendered or reconstructed.
pub fn run(words: &[String]) -> Result<(), Box<dyn Error>> {
    let asked = |word: &str| words.iter().any(|w| w == word);
    let every = if asked("quick") { 7 } else { 1 };
    println!(
        "room and variant | L1 m | visible | occluded | outside | within view | Chamfer m | floaters m3 | iterations | CPU s"
    );
    if asked("rooms") {
        for furnished in [false, true] {
            rooms(furnished, asked("captures"))?;
        }
        return Ok(());
    }
    if asked("ambient") {
        return ambient(every);
    }
    if asked("captures") && !asked("peers") {
        return captured(every);
    }
    let rows = match (asked("peers"), asked("sampling")) {
        (true, _) => peers(asked("captures")),
        (false, true) => sampling(),
        (false, false) => rows(),
    };
    let chosen = |name: &str| {
        let mut choices = words.iter().filter_map(|w| w.strip_prefix('=')).peekable();
        choices.peek().is_none() || choices.any(|text| name.contains(text))
    };
    for row in rows.iter().filter(|row| chosen(row.name)) {
        measure(row, every)?;
    }
    Ok(())
}

/// Returns PlatoNeRF's room from the truth in bins of 128 ps.
fn usual() -> Row {
    Row {
        name: "chair, 192 nodes",
        room: PlatoSettings::default(),
        how: Disturbed {
            bin_width_m: BIN_M,
            ..Disturbed::default()
        },
        settings: Settings::default(),
        captures: false,
        grid: 0,
        method: Method::Grid,
    }
}

/// Returns rows with coarser times and images, and grids of spots.
fn sampling() -> Vec<Row> {
    let base = usual();
    let bins = |name, times: f32| Row {
        name,
        how: Disturbed {
            bin_width_m: BIN_M * times,
            ..base.how
        },
        ..base
    };
    let pixels = |name, resolution| Row {
        name,
        room: PlatoSettings {
            resolution,
            ..base.room
        },
        ..base
    };
    let grid = |name, grid| Row { name, grid, ..base };
    vec![
        bins("bins of 32 ps", 0.25),
        bins("bins of 128 ps", 1.0),
        bins("bins of 256 ps", 2.0),
        bins("bins of 512 ps", 4.0),
        bins("bins of 1,024 ps", 8.0),
        pixels("256 pixels", 256),
        pixels("128 pixels", 128),
        pixels("64 pixels", 64),
        grid("grid of 4 spots", 4),
        grid("grid of 25 spots", 25),
        grid("grid of 100 spots", 100),
    ]
}

fn rows() -> Vec<Row> {
    let base = usual();
    let room = |name, room| Row { name, room, ..base };
    let with = |name, settings| Row {
        name,
        settings,
        ..base
    };
    let how = |name, how| Row { name, how, ..base };
    let (r, s, d) = (base.room, base.settings, base.how);
    let object = |name, object| room(name, PlatoSettings { object, ..r });
    let spots = |name, spots| room(name, PlatoSettings { spots, ..r });
    let dark = |row: Row, name| Row {
        name,
        settings: Settings {
            shadows: Shadows::Ignore,
            ..s
        },
        ..row
    };
    vec![
        with("chair, 96 nodes", Settings { nodes: 96, ..s }),
        with("chair, 128 nodes", Settings { nodes: 128, ..s }),
        base,
        with("chair, 256 nodes", Settings { nodes: 256, ..s }),
        with(
            "chair, 30 iterations",
            Settings {
                iterations: 30,
                ..s
            },
        ),
        with(
            "chair, 300 iterations",
            Settings {
                iterations: 300,
                ..s
            },
        ),
        with("chair, without planes", Settings { planes: false, ..s }),
        with(
            "chair, carving only",
            Settings {
                shadows: Shadows::Carve,
                ..s
            },
        ),
        dark(base, "chair, without shadows"),
        object("armchair", PlatoObject::Armchair),
        object("hidden box", PlatoObject::HiddenBox),
        dark(
            object("", PlatoObject::HiddenBox),
            "hidden box, without shadows",
        ),
        spots("chair, 1 spot", 1),
        spots("chair, 2 spots", 2),
        spots("chair, 4 spots", 4),
        spots("chair, 8 spots", 8),
        room(
            "chair, 256 pixels",
            PlatoSettings {
                resolution: 256,
                ..r
            },
        ),
        room(
            "chair, 128 pixels",
            PlatoSettings {
                resolution: 128,
                ..r
            },
        ),
        how(
            "chair, exact times",
            Disturbed {
                bin_width_m: 0.0,
                ..d
            },
        ),
        how(
            "chair, times with noise of 5 cm",
            Disturbed { noise_m: 0.05, ..d },
        ),
        how(
            "chair, smooth depth error of 2 cm",
            Disturbed {
                smooth_m: 0.02,
                ..d
            },
        ),
        how(
            "chair, smooth depth error of 5 cm",
            Disturbed {
                smooth_m: 0.05,
                ..d
            },
        ),
        how(
            "chair, 2 % wrong mask pixels",
            Disturbed { flipped: 0.02, ..d },
        ),
        how(
            "chair, 10 % wrong mask pixels",
            Disturbed { flipped: 0.1, ..d },
        ),
    ]
}

/// Evaluates rooms from rendered captures, each with several settings.
fn captured(every: usize) -> Result<(), Box<dyn Error>> {
    let s = Settings::default();
    let dark = Settings {
        shadows: Shadows::Ignore,
        ..s
    };
    let open = Settings { planes: false, ..s };
    let fine = Settings {
        nodes: Settings::FINE_NODES,
        ..s
    };
    let coarse: &[(&str, Settings)] = &[("192 nodes", s)];
    let all = &[
        ("192 nodes", s),
        ("256 nodes", fine),
        ("without planes", open),
        ("without shadows", dark),
    ];
    for (name, object, resolution, variants) in [
        ("chair", PlatoObject::Chair, 128, coarse),
        ("chair", PlatoObject::Chair, 256, coarse),
        ("chair", PlatoObject::Chair, 512, all),
        ("hidden box", PlatoObject::HiddenBox, 512, all),
        ("armchair", PlatoObject::Armchair, 512, all),
    ] {
        let room = PlatoSettings {
            object,
            resolution,
            ..PlatoSettings::default()
        };
        let scene = plato::generate(&room)?;
        let measured = measured(&scene, &Disturbed::default(), true)?;
        for (variant, settings) in variants {
            let measured = measured.clone();
            let made = timed(|| grid(measured, *settings))?;
            let name = format!("{name}, {resolution} pixels, {variant}");
            judge(&name, &scene, made, every)?;
        }
    }
    Ok(())
}

/// Evaluates the chair from captures of 256 pixels with a simulated detector.
fn ambient(every: usize) -> Result<(), Box<dyn Error>> {
    let room = PlatoSettings {
        resolution: 256,
        ..PlatoSettings::default()
    };
    let scene = plato::generate(&room)?;
    let settings = rendering();
    let sensor = |photons: f64, ambient: f64| Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        scale: Scale::Peak { photons },
        dark_per_bin: ambient,
        ..Sensor::default()
    };
    let mut variants = vec![("as rendered".to_owned(), None)];
    for (photons, ambient) in [
        (300.0, 0.0),
        (100.0, 0.0),
        (30.0, 0.0),
        (100.0, 1.0),
        (100.0, 4.0),
        (100.0, 16.0),
        (300.0, 100.0),
    ] {
        let name = format!("{photons} photons, {ambient} ambient a bin");
        variants.push((name, Some(sensor(photons, ambient))));
    }
    let mut all = Vec::new();
    for (name, sensor) in variants {
        let laser = scene.laser.clone();
        let empty = Captures::new(scene.camera, laser, settings.gate, LIT_THRESHOLD);
        let captures = match &sensor {
            Some(sensor) => empty.behind(sensor, 0)?,
            None => empty,
        };
        all.push((name, captures));
    }
    let mut alone = scene.clone();
    for (beam, of) in scene.laser.beams.iter().enumerate() {
        alone.laser.beams = vec![*of];
        let rendered = render(&alone, &settings.render_settings(), &Unstopped)?;
        for (_, captures) in &mut all {
            captures.add(beam, &rendered.transient)?;
        }
    }
    for (name, captures) in all {
        let measured = captures.finish();
        let made = timed(|| grid(measured, Settings::default()))?;
        judge(&format!("chair, 256 pixels, {name}"), &scene, made, every)?;
    }
    Ok(())
}

/// Returns each method on two rooms; from captures, at 256 pixels.
fn peers(captures: bool) -> Vec<Row> {
    let rooms = [
        ("chair", PlatoObject::Chair),
        ("hidden box", PlatoObject::HiddenBox),
    ];
    let methods = [
        ("bounce-flash lidar", Method::BounceFlash),
        ("depth, behind it solid", Method::DepthAlone(Behind::Solid)),
        ("depth, behind it empty", Method::DepthAlone(Behind::Empty)),
        ("grid", Method::Grid),
    ];
    let mut rows = Vec::new();
    for (room, object) in rooms {
        for (name, method) in methods {
            let all = PlatoSettings::default();
            rows.push(Row {
                name: format!("{room}, {name}").leak(),
                room: PlatoSettings {
                    object,
                    resolution: if captures { 256 } else { all.resolution },
                    ..all
                },
                how: Disturbed {
                    bin_width_m: BIN_M,
                    ..Disturbed::default()
                },
                settings: Settings::default(),
                captures,
                grid: 0,
                method,
            });
        }
    }
    rows
}

fn measure(row: &Row, every: usize) -> Result<(), Box<dyn Error>> {
    let mut scene = plato::generate(&row.room)?;
    if let Some(aim) = Aim::grid(row.grid) {
        scene.laser = aim.laser(&scene.camera);
    }
    let measured = measured(&scene, &row.how, row.captures)?;
    judge(row.name, &scene, timed(|| row.field(measured))?, every)
}

/// Prints a field's errors in every `every`-th of PlatoNeRF's views.
fn judge(
    name: &str,
    scene: &Scene,
    ((field, iterations), seconds): ((Field, u32), f64),
    every: usize,
) -> Result<(), Box<dyn Error>> {
    let views: Vec<_> = plato::views(SIDE)
        .into_iter()
        .skip(every / 2)
        .step_by(every)
        .collect();
    let world = World::new(scene);
    let score = score_views(&Renderer::new(&field), &scene.camera, &world, &views);
    let mesh = mesh_score(&surface(&field), &world, &field, 0)?;
    let floating = floaters(&field, &world, 0)?;
    show(
        name,
        &score,
        (mesh.chamfer_m, floating.volume_m3),
        iterations,
        seconds,
    );
    Ok(())
}

/// Returns this crate's field, and its number of iterations.
fn grid(measured: Measured, settings: Settings) -> Result<(Field, u32), ReconstructError> {
    let made = reconstruct(measured, settings, &Unwatched)?;
    Ok((made.field, made.iterations))
}

fn measured(scene: &Scene, how: &Disturbed, captures: bool) -> Result<Measured, Box<dyn Error>> {
    if !captures {
        return Ok(from_truth(scene, &truth_of(scene, &Unstopped)?, how)?);
    }
    Ok(captures_of(scene, &rendering(), &|_, _| true)?)
}

/// Returns the settings for rendering captures.
fn rendering() -> CaptureSettings {
    CaptureSettings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: f64::from(BIN_M),
            bins: 391,
        },
        samples: 8,
        seed: 0,
        sensor: None,
    }
}

impl Row {
    fn field(&self, measured: Measured) -> Result<(Field, u32), ReconstructError> {
        match self.method {
            Method::Grid => grid(measured, self.settings),
            Method::BounceFlash => Ok((bounce_flash(&measured, self.settings.nodes)?, 0)),
            Method::DepthAlone(behind) => Ok((depth_alone(&measured, &self.settings, behind)?, 0)),
        }
    }
}

/// Returns the result of `make`, and its CPU-seconds.
fn timed<T>(
    make: impl FnOnce() -> Result<T, ReconstructError>,
) -> Result<(T, f64), Box<dyn Error>> {
    let cpu = || {
        let t = clock_gettime(ClockId::ProcessCPUTime);
        t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
    };
    let start = cpu();
    let made = make()?;
    Ok((made, cpu() - start))
}

fn show(name: &str, s: &ViewScore, (chamfer, floating): (f64, f64), iterations: u32, seconds: f64) {
    let [all, visible, occluded, outside, within] =
        [s.all, s.visible, s.occluded, s.outside, s.within_view].map(|split| split.l1_m);
    println!(
        "{name} | {all:.4} | {visible:.4} | {occluded:.4} | {outside:.4} | {within:.4} | {chamfer:.4} | {floating:.4} | {iterations} | {seconds:.1}"
    );
}

/// Prints means over unseen rooms of 256 pixels and 25 spots.
fn rooms(furnished: bool, captures: bool) -> Result<(), Box<dyn Error>> {
    let library = AssetLibrary::parametric();
    let (mut sums, mut seconds, mut count) = ([0.0f64; 4], 0.0, 0.0f64);
    for seed in 1000..1000 + ROOMS {
        let scene = match furnished {
            true => furnished::generate(seed, &FurnishedSettings::default(), &library)?,
            false => primitive::generate(seed, &PrimitiveSettings::default())?,
        };
        let measured = measured(&scene, &Disturbed::default(), captures)?;
        let (made, took) = timed(|| reconstruct(measured, Settings::default(), &Unwatched))?;
        let world = World::new(&scene);
        let views = around(&made.measured, &made.depth.range, &world, 24, SIDE);
        let s = score_views(&Renderer::new(&made.field), &scene.camera, &world, &views);
        if s.all.pixels == 0 {
            continue;
        }
        let split = [s.all, s.visible, s.occluded, s.outside].map(|split| split.l1_m);
        sums.iter_mut().zip(split).for_each(|(sum, x)| *sum += x);
        (seconds, count) = (seconds + took, count + 1.0);
        println!("  seed {seed}: {:.4} ({} views)", s.all.l1_m, s.views);
    }
    let kind = if furnished { "furnished" } else { "primitive" };
    let source = if captures { "captures" } else { "truth" };
    let [all, visible, occluded, outside] = sums.map(|sum| sum / count.max(1.0));
    println!(
        "{count} {kind} rooms, {source} | {all:.4} | {visible:.4} | {occluded:.4} | {outside:.4} | | | | | {:.1}",
        seconds / count.max(1.0)
    );
    Ok(())
}
