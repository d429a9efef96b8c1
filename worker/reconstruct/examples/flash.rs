//! Rooms in 3D from one flash, next to the same rooms from true times and masks, from the flash's
//! depth with true masks, and from true depth with the flash's masks: a line each with the errors
//! of 24 novel views, and their mean. This shows what limits a room from one flash. Rooms are
//! furnished, parametric, of seeds 93001 and on; nothing is read or written.
//!
//! In the environment, `ROOMS` (6), `FIRST` (93001), `SPOTS` (25), `SIDE` (128 pixels), `NODES`
//! (96), `WIDTH` (0.0768, of a bin, metres).

use std::{env, time::Instant};

use picofarm_demultiplex::{Capture, Place, Settings as Method, Spot, demultiplex, shadows_at};
use picofarm_reconstruct::{
    Measured, Settings, Unwatched, World, reconstruct,
    render::Renderer,
    score,
    source::{CaptureSettings, Disturbed, from_flash, from_truth},
};
use picofarm_scene::{AssetLibrary, Scene, furnished};
use picofarm_settings::Spots;
use picofarm_transient::{Gate, Progress, render};

struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

fn number(name: &str, usual: f64) -> f64 {
    let text = env::var(name).ok();
    text.map_or(usual, |text| {
        text.parse()
            .unwrap_or_else(|_| panic!("{name}={text:?} is no number"))
    })
}

/// L1 in metres: all, visible, occluded, outside, mirrors; floaters, m³; seconds.
type Row = [f64; 7];

fn score_of(measured: Measured, scene: &Scene, seconds: f64) -> Row {
    let settings = Settings {
        nodes: number("NODES", 96.0) as u32,
        accept_inconsistent: true,
        ..Settings::default()
    };
    let start = Instant::now();
    let made = reconstruct(measured, settings, &Unwatched).expect("a reconstruction");
    let seconds = seconds + start.elapsed().as_secs_f64();
    let world = World::new(scene);
    let views = score::around(&made.measured, &made.depth.range, &world, 24, 128);
    let renderer = Renderer::new(&made.field);
    let views = score::score_views(&renderer, &made.measured.camera, &world, &views);
    let floaters = score::floaters(&made.field, &world, 0).expect("a scene");
    [
        views.all.l1_m,
        views.visible.l1_m,
        views.occluded.l1_m,
        views.outside.l1_m,
        views.specular.l1_m,
        floaters.volume_m3,
        seconds,
    ]
}

/// The inputs of the rows of a room.
const INPUTS: [&str; 4] = ["truth", "flash", "flash, true masks", "true depth"];

fn room(seed: u64) -> [Row; 4] {
    let side = number("SIDE", 128.0) as u32;
    let settings = furnished::FurnishedSettings {
        spots: Spots::Grid(number("SPOTS", 25.0) as u32),
        width: side,
        height: side,
        ..Default::default()
    };
    let scene = furnished::generate(seed, &settings, &AssetLibrary::parametric()).expect("a room");
    let width = number("WIDTH", 0.0768);
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: width,
        bins: (24.46 / width) as u32,
    };
    let settings = CaptureSettings {
        gate,
        samples: 12,
        seed,
        sensor: None,
    };
    let rendered = render(&scene, &settings.render_settings(), &Unstopped).expect("a render");
    let beams: Vec<usize> = (0..rendered.spots.len())
        .filter(|k| rendered.spots[*k].is_some())
        .collect();
    let spots: Vec<Spot> = beams
        .iter()
        .map(|k| Spot {
            direction: scene.laser.beams[*k].direction,
            place: rendered.spots[*k].as_ref().map(|s| Place {
                point: s.point,
                path_m: s.path_m,
            }),
        })
        .collect();
    let capture = Capture {
        histogram: &rendered.transient,
        gate,
        camera: &scene.camera,
        laser: scene.laser.origin,
        spots: &spots,
    };
    let start = Instant::now();
    let found = demultiplex(&capture, &Method::default()).expect("a capture");
    let seconds = start.elapsed().as_secs_f64();
    let flash = from_flash(&capture, &found, &beams).expect("sizes that fit");
    let truth = from_truth(&scene, &rendered, &Disturbed::default()).expect("a truth");
    let pixels = capture.pixels();
    let mut masks = found;
    masks.lit = beams
        .iter()
        .flat_map(|beam| &rendered.truth.visibility[beam * pixels..][..pixels])
        .map(|v| f32::from(*v))
        .collect();
    let masks = from_flash(&capture, &masks, &beams).expect("sizes that fit");
    let depth = shadows_at(&capture, &rendered.truth.depth, &Method::default()).expect("depths");
    let depth = from_flash(&capture, &depth, &beams).expect("sizes that fit");
    [
        score_of(truth, &scene, 0.0),
        score_of(flash, &scene, seconds),
        score_of(masks, &scene, seconds),
        score_of(depth, &scene, seconds),
    ]
}

fn show(name: &str, rows: &[Row; 4]) {
    for (input, row) in INPUTS.iter().zip(rows) {
        let figures: Vec<String> = row.iter().map(|x| format!("{x:.3}")).collect();
        println!("| {name} | {input} | {} |", figures.join(" | "));
    }
}

fn main() {
    let first = number("FIRST", 93001.0) as u64;
    let count = number("ROOMS", 6.0) as u64;
    println!(
        "| room | input | L1, m | visible | occluded | outside | mirrors | floaters, m³ | s |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    let mut all = Vec::new();
    for seed in first..first + count {
        let rows = room(seed);
        show(&seed.to_string(), &rows);
        all.push(rows);
    }
    let mean = |input: usize, k: usize| {
        let sum: f64 = all.iter().map(|rows| rows[input][k]).sum();
        sum / all.len() as f64
    };
    show(
        "mean",
        &std::array::from_fn(|input| std::array::from_fn(|k| mean(input, k))),
    );
}
