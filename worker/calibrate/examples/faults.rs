//! Faults of a calibration against their effect on depth, 3D points and shadows, as stated and
//! after the correction: a line each, the mean over rooms. With `FLASH` in the environment,
//! verdicts of captures of all spots at once instead.
//!
//! In the environment: `ROOMS` (2), `FIRST` (7, the first seed), `SIDE` (64 pixels), `PHOTONS`
//! (100, in the brightest bin of the median pixel and one spot), `MIRRORS` (0).

#[path = "../tests/it/common/mod.rs"]
mod common;

use std::{env, str::FromStr};

use common::{Capturing, Room, faults};
use picofarm_calibrate::{Measurement, check};
use picofarm_demultiplex::{Capture, Settings, Truth, demultiplex, score};
use picofarm_scene::Camera;

fn variable<T: FromStr>(name: &str, usual: T) -> T {
    let text = env::var(name).ok();
    text.map_or(usual, |text| {
        text.parse()
            .unwrap_or_else(|_| panic!("{name}={text:?} cannot be read; see the example's head"))
    })
}

/// Depth MAE and mean distance of 3D points, metres; IoU of masks.
type Effect = [f64; 3];

fn effect(room: &Room, capture: &Capture, stated: Option<&[u8]>) -> Effect {
    let truth = Truth {
        depth_m: &room.depth,
        specular: &room.specular,
        visibility: &room.visibility,
    };
    let found = demultiplex(capture, &Settings::default()).expect("a capture");
    let width = room.camera.intrinsics.width as usize;
    let point = |camera: &Camera, p: usize, z: f32| {
        camera.ray((p % width) as f32 + 0.5, (p / width) as f32 + 0.5) * z
    };
    let seen: Vec<usize> = (0..room.depth.len())
        .filter(|p| room.depth[*p] > 0.0 && room.specular[*p] == 0)
        .collect();
    let apart = |p: &usize| {
        let right = point(&room.camera, *p, room.depth[*p]);
        f64::from((point(capture.camera, *p, found.depth_m[*p]) - right).length())
    };
    let masks = match stated {
        Some(stated) => {
            let pairs = || stated.iter().zip(&room.visibility);
            let both = pairs().filter(|(a, b)| **a != 0 && **b != 0).count();
            let either = pairs().filter(|(a, b)| **a != 0 || **b != 0).count();
            both as f64 / either as f64
        }
        None => score::masks(&found, &truth).expect("masks").iou,
    };
    [
        score::depth(&found.depth_m, &truth).mae_m,
        seen.iter().map(apart).sum::<f64>() / seen.len() as f64,
        masks,
    ]
}

/// One fault in one room: named causes, effects as stated and corrected.
fn row(room: &Room, capture: &Capturing, masks: &[u8], own: bool) -> (String, Effect, Effect) {
    let checked = check(&Measurement {
        capture: capture.capture(),
        per_spot: Some(&capture.per_spot),
        masks: Some(masks),
        pulses: None,
    })
    .expect("a capture");
    let found = &checked.corrected;
    let mut corrected = capture.clone();
    corrected.per_spot = found.histograms(&capture.per_spot);
    corrected.add_up();
    corrected.camera = found.camera;
    corrected.gate = found.gate;
    corrected.laser = found.laser;
    corrected.spots.clone_from(&found.spots);
    let ordered = found.masks(masks);
    let before = effect(room, &capture.capture(), own.then_some(masks));
    let after = effect(room, &corrected.capture(), own.then_some(&ordered));
    let names = checked
        .report
        .causes
        .iter()
        .map(|c| format!("{:?}", c.fault));
    let names: Vec<String> = names.collect();
    let verdict = checked.report.verdict.name();
    let text = match names.is_empty() {
        true => verdict.into(),
        false => format!("{verdict}: {}", names.join(", ")),
    };
    (text, before, after)
}

fn main() {
    let (first, count) = (variable("FIRST", 7), variable("ROOMS", 2u64));
    let (side, photons) = (variable("SIDE", 64), variable("PHOTONS", 100.0));
    let rooms: Vec<Room> = (first..first + count)
        .map(|seed| Room::new(seed, side, variable("MIRRORS", 0)))
        .collect();
    let captures: Vec<_> = rooms
        .iter()
        .map(|room| faults(room, &room.measure(photons, 1, |_| {}), |_| true))
        .collect();
    if env::var_os("FLASH").is_some() {
        return flashes(&captures);
    }
    println!(
        "| fault | verdict and causes | depth MAE, m: stated | corrected | 3D points, m: stated | corrected | masks IoU: stated | corrected |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- |");
    for n in 0..captures[0].len() {
        let (mut before, mut after) = ([0.0; 3], [0.0; 3]);
        let mut names: Vec<String> = Vec::new();
        for (room, captures) in rooms.iter().zip(&captures) {
            let (name, capture, masks) = &captures[n];
            let (text, stated, corrected) = row(room, capture, masks, name.contains("masks"));
            for k in 0..3 {
                before[k] += stated[k] / count as f64;
                after[k] += corrected[k] / count as f64;
            }
            if !names.contains(&text) {
                names.push(text);
            }
        }
        println!(
            "| {} | {} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} |",
            captures[0][n].0,
            names.join("; "),
            before[0],
            after[0],
            before[1],
            after[1],
            before[2],
            after[2]
        );
    }
}

fn flashes(captures: &[Vec<common::Disturbed>]) {
    println!("| room | fault | verdict and causes | peaks, of the distance by chance |");
    println!("| --- | --- | --- | --- |");
    for (room, captures) in captures.iter().enumerate() {
        for (name, capture, _) in captures {
            let checked = check(&Measurement {
                capture: capture.capture(),
                per_spot: None,
                masks: None,
                pulses: None,
            })
            .expect("a capture");
            let report = &checked.report;
            let names: Vec<String> = report
                .causes
                .iter()
                .map(|c| format!("{:?} {:.3}", c.fault, c.value))
                .collect();
            println!(
                "| {room} | {name} | {}: {} | {:.3} |",
                report.verdict.name(),
                names.join(", "),
                report.unclear.unwrap_or(f64::NAN)
            );
        }
    }
}
