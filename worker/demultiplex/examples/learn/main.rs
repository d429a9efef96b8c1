//! Learns the model of shadows (`shadows = "learned"`) from rendered rooms, and writes its weights.
//! Rooms are parametric, of three image sizes, so that the model holds for any. The committed
//! weights are those of the defaults.
//!
//! In the environment, `SETS` (pixels a side : first seed : rooms, comma separated;
//! 128:95001:24,256:95101:6,64:95201:8), `TREES` (200, of each of two forests), `PAIRS` (20000, of
//! a room), `CACHE` (a folder that keeps rendered rooms), and `OUT`
//! (worker/demultiplex/src/learned.bin).

mod boost;
#[path = "../common/mod.rs"]
mod common;

use std::fs;

use common::{Kind, Room, variable};
use picofarm_demultiplex::{
    Settings,
    learning::{Forest, features},
};

/// Pairs of one room, by spot.
fn pairs(room: &Room, seed: u64, count: usize) -> Vec<(usize, usize)> {
    let pixels = room.depth.len();
    let mut state = seed;
    let mut all: Vec<(usize, usize)> = (0..count)
        .map(|_| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            let q = (state >> 33) as usize % (room.spots.len() * pixels);
            (q / pixels, q % pixels)
        })
        .filter(|(spot, p)| room.spots[*spot].place.is_some() && room.depth[*p] > 0.0)
        .collect();
    all.sort_unstable();
    all.dedup();
    all
}

/// The kinds and seeds of all rooms.
fn sets() -> Vec<(Kind, u64)> {
    let text: String = variable("SETS", "128:95001:24,256:95101:6,64:95201:8".into());
    let set = |part: &str| -> Option<Vec<(Kind, u64)>> {
        let numbers: Vec<u64> = part.split(':').map_while(|n| n.parse().ok()).collect();
        let &[side, first, rooms] = &numbers[..] else {
            return None;
        };
        let kind = Kind {
            side: u32::try_from(side).ok()?,
            ..Kind::of_environment()
        };
        Some(
            (first..first + rooms)
                .map(|seed| (kind.clone(), seed))
                .collect(),
        )
    };
    let all: Option<Vec<_>> = text.split(',').map(set).collect();
    let all = all.unwrap_or_else(|| panic!("SETS={text:?}: expected SIDE:FIRST:ROOMS,..."));
    all.concat()
}

/// Features and answers of all rooms: half from their own depth, half from the truth's.
fn gather(first_forest: Option<&Forest>) -> (Vec<Vec<f32>>, Vec<bool>) {
    let count = variable("PAIRS", 20_000usize);
    let (mut all, mut lit) = (Vec::new(), Vec::new());
    for (kind, seed) in sets() {
        let room = Room::new(seed, &kind);
        for depth in [None, Some(&room.depth[..])] {
            let salt = seed * 2 + u64::from(depth.is_some());
            let pairs = pairs(&room, salt, count / 2);
            let found = features(
                &room.capture(),
                &Settings::default(),
                depth,
                first_forest,
                &pairs,
            )
            .expect("a room that can be used");
            all.resize(found.len(), Vec::new());
            for (all, found) in all.iter_mut().zip(found) {
                all.extend(found);
            }
            let pixels = room.depth.len();
            lit.extend(
                pairs
                    .iter()
                    .map(|(s, p)| room.visibility[s * pixels + p] != 0),
            );
        }
    }
    (all, lit)
}

/// Share of wrong answers.
fn wrong(forest: &Forest, features: &[Vec<f32>], lit: &[bool]) -> f64 {
    let cut: Vec<Vec<u8>> = features
        .iter()
        .zip(&forest.borders)
        .map(|(f, b)| f.iter().map(|v| Forest::cut(b, *v)).collect())
        .collect();
    let odds = forest.log_odds(&cut, lit.len());
    let off = odds.iter().zip(lit).filter(|(o, l)| (**o > 0.0) != **l);
    off.count() as f64 / lit.len() as f64
}

fn main() {
    let trees = variable("TREES", 200usize);
    let out: String = variable("OUT", "worker/demultiplex/src/learned.bin".into());
    let mut forests = Vec::new();
    for round in 1..=2 {
        let (features, lit) = gather(forests.first());
        let forest = boost::learn(&features, &lit, trees);
        println!(
            "forest {round}: {} pairs, {} features, {:.4} of its own pairs wrong",
            lit.len(),
            features.len(),
            wrong(&forest, &features, &lit)
        );
        forests.push(forest);
    }
    let bytes = Forest::write(&forests);
    fs::write(&out, &bytes)
        .unwrap_or_else(|e| panic!("{out}: {e}; set OUT to a path that can be written"));
    println!("{out}: {} bytes", bytes.len());
}
