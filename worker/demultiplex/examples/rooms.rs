//! The method's figures on furnished rooms that nothing was tuned on, a line each, their mean, and
//! the worst: depth, masks from its own depth, masks from the true depth, mirrors, seconds.
//!
//! In the environment, `ROOMS` (20), `FIRST` (91001, the first seed), `SIDE` (128 pixels), `SPOTS`
//! (25), `ERROR` (0.1, of the renders), `ASSETS` (parametric, or sweethome3d from the folder
//! `ASSETS_DIR`), `CACHE` (a folder that keeps rendered rooms), `SHADOWS` (physics or
//! learned, instead of the default), and `RETURNS` takes the spots' places from their own
//! one-bounce returns.

#[path = "common/mod.rs"]
mod common;

use std::time::Instant;

use common::{Kind, Room, settings, variable};
use picofarm_demultiplex::{Demultiplexed, demultiplex, score, shadows_at};

/// Depth MAE, mirrors' MAE (NaN without any), median; IoU and IoU over carrying pairs from its own
/// depth; the same from the true depth; IoU of "all lit"; IoU of mirrors; seconds.
type Row = [f64; 10];

fn scores(room: &Room) -> Row {
    let capture = room.capture();
    let truth = room.truth();
    let settings = settings();
    let start = Instant::now();
    let own = demultiplex(&capture, &settings).expect("a capture");
    let seconds = start.elapsed().as_secs_f64();
    let at_truth = shadows_at(&capture, truth.depth_m, &settings).expect("a capture");
    let depth = score::depth(&own.depth_m, &truth);
    let mirrors = score::mirrors(&own, &truth);
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
        mirrors.unwrap_or(f64::NAN),
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
        mirror_iou,
        seconds,
    ] = row;
    println!(
        "| {name} | {mae:.4} | {mirrors:.3} | {:.1} | {own:.3} ({own_carrying:.3}) | {truth:.3} ({truth_carrying:.3}) | {all_lit:.3} | {mirror_iou:.3} | {seconds:.1} |",
        median * 1e3
    );
}

fn main() {
    let kind = Kind::of_environment();
    let (first, count) = (variable("FIRST", 91001), variable("ROOMS", 20u64));
    println!(
        "| room | depth MAE, m | mirrors, m | median, mm | IoU from own depth (pairs that carry light) | from true depth | \"all lit\" | mirrors IoU | seconds |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    let mut rows = Vec::new();
    for seed in first..first + count {
        let row = scores(&Room::new(seed, &kind));
        show(&seed.to_string(), &row);
        rows.push(row);
    }
    let known = |k: usize| -> Vec<f64> {
        let all = rows.iter().map(|r| r[k]);
        all.filter(|x| x.is_finite()).collect()
    };
    show(
        "mean",
        &std::array::from_fn(|k| known(k).iter().sum::<f64>() / known(k).len() as f64),
    );
    let worst = |k: usize| match k {
        0..=2 | 9 => known(k).into_iter().fold(f64::NAN, f64::max),
        _ => known(k).into_iter().fold(f64::NAN, f64::min),
    };
    show("worst of each", &std::array::from_fn(worst));
}
