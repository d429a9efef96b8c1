//! Scenes of other sizes than a room's, and pulses wider than a bin.

use crate::common;

use common::{Room, Shape, grid};
use picofarm_demultiplex::{Capture, Demultiplexed, Place, Settings, Spot, demultiplex};
use picofarm_scene::{Camera, Vec3};
use picofarm_settings::Gate;

const SIDE: u32 = 48;

fn median_error(room: &Room, found: &Demultiplexed) -> f32 {
    let pairs = room.depth.iter().zip(&found.depth_m);
    let mut all: Vec<f32> = pairs.map(|(z, f)| (z - f).abs()).collect();
    all.sort_by(f32::total_cmp);
    all[all.len() / 2]
}

fn wrong_masks(room: &Room, found: &Demultiplexed) -> f64 {
    let all = found.mask();
    let wrong = all.iter().zip(&room.lit).filter(|(a, b)| a != b).count();
    wrong as f64 / all.len() as f64
}

#[test]
fn a_scene_of_another_size_comes_back_to_the_same_bits() {
    let room = Room::new(SIDE, &grid(5), None);
    let beams = room.beams(true);
    let whole = demultiplex(&room.capture(&beams), &Settings::default()).expect("a room");
    // Eight times smaller is a box on a table, and sixteen times larger a hall.
    for size in [0.125f32, 16.0] {
        let spots: Vec<Spot> = beams
            .iter()
            .map(|beam| Spot {
                place: beam.place.map(|place| Place {
                    point: place.point * size,
                    path_m: place.path_m * size,
                }),
                ..*beam
            })
            .collect();
        let camera = Camera {
            origin: room.camera.origin * size,
            ..room.camera
        };
        let capture = Capture {
            gate: Gate {
                start_m: room.gate.start_m * f64::from(size),
                bin_width_m: room.gate.bin_width_m * f64::from(size),
                ..room.gate
            },
            camera: &camera,
            laser: room.laser * size,
            ..room.capture(&spots)
        };
        let found = demultiplex(&capture, &Settings::default()).expect("a room");
        let expected: Vec<f32> = whole.depth_m.iter().map(|z| z * size).collect();
        assert!(found.depth_m == expected, "depths at {size}");
        assert!(found.lit == whole.lit, "masks at {size}");
        assert_eq!(
            found.places,
            spots.iter().map(|s| s.place).collect::<Vec<_>>()
        );
    }
}

/// A pulse that rises fast and falls slowly: 128 ps wide at half of its peak in bins of 16 ps.
fn pulse() -> Vec<f32> {
    let rise = (0..8).map(|k| 0.5f32.powf((7 - k) as f32 / 2.0));
    let fall = (1..60).map(|k| 0.8f32 * 0.87f32.powi(k) + 0.2 * 0.96f32.powi(k));
    let all: Vec<f32> = rise.chain(fall).collect();
    let sum: f32 = all.iter().sum();
    all.iter().map(|x| x / sum).collect()
}

#[test]
fn a_pulse_wider_than_a_tenth_of_the_room_costs_little() {
    let shape = Shape {
        size: 0.25,
        ..Shape::PLAIN
    };
    let gate = Gate {
        start_m: 0.25,
        bin_width_m: 0.0048,
        bins: 960,
    };
    let mut room = Room::shaped(SIDE, &grid(4), None, gate, Vec3::ZERO, shape, |_, _| true);
    let beams = room.beams(true);
    let sharp = demultiplex(&room.capture(&beams), &Settings::default()).expect("a room");
    let (pulse, bins) = (pulse(), gate.bins as usize);
    for h in room.histogram.chunks_mut(bins) {
        let light = h.to_vec();
        h.fill(0.0);
        for (bin, x) in light.iter().enumerate().filter(|(_, x)| **x > 0.0) {
            for (k, share) in pulse.iter().enumerate() {
                if let Some(h) = (bin + k).checked_sub(7).and_then(|b| h.get_mut(b)) {
                    *h += share * x;
                }
            }
        }
    }
    let blurred = demultiplex(&room.capture(&beams), &Settings::default()).expect("a room");
    let [best, found] = [&sharp, &blurred].map(|found| median_error(&room, found));
    assert!(best < 0.002, "{best} m without the pulse");
    assert!(found < 0.003, "{found} m with the pulse, {best} m without");
    let [best, found] = [&sharp, &blurred].map(|found| wrong_masks(&room, found));
    assert!(
        found < best + 0.05,
        "{found} of the masks with the pulse, {best} without"
    );
}
