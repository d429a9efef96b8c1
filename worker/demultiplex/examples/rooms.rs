//! The method's figures on furnished rooms that nothing was tuned on, a line each and their mean:
//! depth, masks from its own depth, masks from the true depth, seconds. Rooms are parametric, of
//! seeds 91001 and on; nothing is read or written.
//!
//! In the environment, `ROOMS` (20), `FIRST` (91001), `SIDE` (128 pixels), `SPOTS` (25), `ERROR`
//! (0.1, of the renders), and `RETURNS` takes the spots' places from their own one-bounce returns.

use std::{env, time::Instant};

use picofarm_demultiplex::{
    Capture, Demultiplexed, Place, Settings, Spot, Truth, demultiplex, score, shadows_at,
};
use picofarm_scene::{AssetLibrary, furnished};
use picofarm_settings::Spots;
use picofarm_transient::{self as transient, Budget, Gate, Progress, Strategy, Wavelength};

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

/// Depth MAE, mirrors' MAE (NaN without any), median; IoU and IoU over carrying pairs from its own
/// depth; the same from the true depth; IoU of "all lit"; seconds.
type Row = [f64; 9];

fn room(seed: u64) -> Row {
    let side = number("SIDE", 128.0) as u32;
    let settings = furnished::FurnishedSettings {
        spots: Spots::Grid(number("SPOTS", 25.0) as u32),
        width: side,
        height: side,
        ..Default::default()
    };
    let library = AssetLibrary::parametric();
    let scene = furnished::generate(seed, &settings, &library).expect("a room");
    let settings = transient::Settings {
        gate: Gate {
            start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 637,
        },
        budget: Budget::Error(number("ERROR", 0.1)),
        max_bounces: None,
        one_bounce: true,
        seed,
        split: false,
        groups: Vec::new(),
        strategy: Strategy::default(),
        beam: None,
        fill_factor: 1.0,
        wavelengths_nm: Wavelength::NONE,
    };
    let rendered = transient::render(&scene, &settings, &Unstopped).expect("a render");
    let returns = env::var_os("RETURNS").is_some();
    let spots: Vec<Spot> = scene
        .laser
        .beams
        .iter()
        .zip(&rendered.spots)
        .map(|(beam, spot)| Spot {
            direction: beam.direction,
            place: spot.filter(|_| !returns).map(|s| Place {
                point: s.point,
                path_m: s.path_m,
            }),
        })
        .collect();
    let capture = Capture {
        histogram: &rendered.transient,
        gate: settings.gate,
        camera: &scene.camera,
        laser: scene.laser.origin,
        spots: &spots,
    };
    let truth = Truth {
        depth_m: &rendered.truth.depth,
        specular: &rendered.truth.specular,
        visibility: &rendered.truth.visibility,
    };
    let start = Instant::now();
    let own = demultiplex(&capture, &Settings::default()).expect("a capture");
    let seconds = start.elapsed().as_secs_f64();
    let at_truth = shadows_at(&capture, truth.depth_m, &Settings::default()).expect("a capture");
    let depth = score::depth(&own.depth_m, &truth);
    let masks = |found: &Demultiplexed| score::masks(found, &truth).expect("masks of all spots");
    let (own, at_truth) = (masks(&own), masks(&at_truth));
    [
        depth.mae_m,
        depth.mirrors_mae_m.unwrap_or(f64::NAN),
        depth.median_m,
        own.iou,
        own.iou_carrying,
        at_truth.iou,
        at_truth.iou_carrying,
        own.all_lit_iou,
        seconds,
    ]
}

fn show(name: &str, row: &Row) {
    let [
        mae,
        mirrors,
        median,
        own,
        own_carrying,
        truth,
        truth_carrying,
        all_lit,
        seconds,
    ] = row;
    println!(
        "| {name} | {mae:.4} | {mirrors:.3} | {:.1} | {own:.3} ({own_carrying:.3}) | {truth:.3} ({truth_carrying:.3}) | {all_lit:.3} | {seconds:.1} |",
        median * 1e3
    );
}

fn main() {
    let first = number("FIRST", 91001.0) as u64;
    let count = number("ROOMS", 20.0) as u64;
    println!(
        "| room | depth MAE, m | mirrors, m | median, mm | IoU from own depth (pairs that carry light) | from true depth | \"all lit\" | seconds |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- |");
    let mut rows = Vec::new();
    for seed in first..first + count {
        let row = room(seed);
        show(&seed.to_string(), &row);
        rows.push(row);
    }
    let mean = |k: usize| {
        let all: Vec<f64> = rows
            .iter()
            .map(|r| r[k])
            .filter(|x| x.is_finite())
            .collect();
        all.iter().sum::<f64>() / all.len() as f64
    };
    show("mean", &std::array::from_fn(mean));
}
