//! A sheet of the best, the median and the worst room by mean error of depth: true depth, found
//! depth, its error, mirrors, and the masks of two spots. Writes a PNG to `OUT` (sheet.png).
//!
//! In the environment: as for the example `rooms`, and `CELL` (104), the side of an image in
//! pixels.

#[path = "common/mod.rs"]
mod common;

use std::fs;

use common::{Kind, Room, settings, variable};
use picofarm_demultiplex::{Demultiplexed, demultiplex, score};
use picofarm_figures::{Canvas, TEXT, inferno, viridis};

const GAP: usize = 4;
const HEAD: usize = TEXT + 6;
const BACKGROUND: [u8; 3] = [255, 255, 255];
const INK: [u8; 3] = [40, 40, 40];
const COLUMNS: usize = 6;
/// Error of depth that is drawn brightest, metres.
const ERROR_M: f32 = 0.2;

/// The colour of an answer: white and dark where it is right, red where light was made up, blue
/// where it was missed.
fn answer(said: bool, truth: bool) -> [u8; 3] {
    match (said, truth) {
        (true, true) => [235; 3],
        (false, false) => [60; 3],
        (true, false) => [220, 60, 50],
        (false, true) => [60, 90, 220],
    }
}

fn row(canvas: &mut Canvas, n: usize, cell: usize, name: &str, room: &Room, found: &Demultiplexed) {
    let side = room.camera.intrinsics.width as usize;
    let pixels = room.depth.len();
    let top = n * (HEAD + cell + GAP);
    let far = room.depth.iter().copied().fold(0.1f32, f32::max);
    let spots = room.spots.len();
    let mut draw = |column: usize, title: &str, colour: &dyn Fn(usize) -> [u8; 3]| {
        let left = GAP + column * (cell + GAP);
        canvas.text(left, top + 3, title, INK);
        canvas.image((left, top + HEAD), cell, (side, side), colour);
    };
    draw(0, name, &|p| viridis(room.depth[p] / far));
    draw(1, "found depth", &|p| viridis(found.depth_m[p] / far));
    draw(2, "error 0-0.2m", &|p| {
        inferno((found.depth_m[p] - room.depth[p]).abs() / ERROR_M)
    });
    draw(3, "mirrors", &|p| {
        answer(found.mirror_probability[p] >= 0.5, room.specular[p] != 0)
    });
    for (column, spot) in [(4, spots / 4), (5, spots * 3 / 4)] {
        draw(column, &format!("lit by {spot}"), &|p| {
            let q = spot * pixels + p;
            answer(found.lit[q] >= 0.5, room.visibility[q] != 0)
        });
    }
}

fn main() {
    let kind = Kind::of_environment();
    let (first, count) = (variable("FIRST", 91001), variable("ROOMS", 20u64));
    let cell = variable("CELL", 104usize);
    let take = |seed: u64| {
        let room = Room::new(seed, &kind);
        let found = demultiplex(&room.capture(), &settings()).expect("a capture");
        let error = score::depth(&found.depth_m, &room.truth()).mae_m;
        (room, found, error)
    };
    let mut errors: Vec<(f64, u64)> = (first..first + count)
        .map(|seed| (take(seed).2, seed))
        .collect();
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    let width = GAP + COLUMNS * (cell + GAP);
    let mut canvas = Canvas::new(width, 3 * (HEAD + cell + GAP), BACKGROUND);
    let chosen = [
        ("best", 0),
        ("median", errors.len() / 2),
        ("worst", errors.len() - 1),
    ];
    for (n, (name, at)) in chosen.into_iter().enumerate() {
        let (error, seed) = errors[at];
        println!("{name}: room {seed}, depth MAE {error:.4} m");
        let (room, found, _) = take(seed);
        row(&mut canvas, n, cell, name, &room, &found);
    }
    let out: String = variable("OUT", "sheet.png".into());
    let png = canvas.png();
    fs::write(&out, &png)
        .unwrap_or_else(|e| panic!("{out}: {e}; set OUT to a path that can be written"));
    println!("{out}: {} bytes", png.len());
}
