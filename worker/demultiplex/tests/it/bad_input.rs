//! Arguments that cannot be used are named; anything finite is taken apart.

use crate::common;

use common::{Room, grid};
use picofarm_demultiplex::{
    Capture, DemultiplexError, Place, Settings, Spot, demultiplex, shadows_at,
};
use picofarm_scene::{Camera, Intrinsics, Vec3};
use picofarm_settings::Gate;
use proptest::prelude::*;

fn refused(capture: &Capture) -> String {
    match demultiplex(capture, &Settings::default()) {
        Err(e) => e.to_string(),
        Ok(_) => panic!("expected an error"),
    }
}

#[test]
fn what_cannot_be_used_is_named() {
    let room = Room::new(8, &grid(2), None);
    let beams = room.beams(true);
    let good = room.capture(&beams);
    let says = |capture: &Capture, what: &str| {
        let said = refused(capture);
        assert!(said.starts_with(what), "{said:?} begins not with {what:?}");
    };
    let short = Capture {
        histogram: &room.histogram[1..],
        ..good
    };
    says(
        &short,
        "histogram: has 30719 values, expected 8 rows x 8 columns x 480 bins",
    );
    let mut broken = room.histogram.clone();
    broken[480 + 7] = f32::NAN;
    let nan = Capture {
        histogram: &broken,
        ..good
    };
    says(&nan, "histogram: is NaN at row 0, column 1, bin 7");
    says(&Capture { spots: &[], ..good }, "spots: there are none");
    let mut spots = beams.clone();
    spots[2].direction = Vec3::ZERO;
    says(
        &Capture {
            spots: &spots,
            ..good
        },
        "spots[2].direction",
    );
    let mut spots = beams.clone();
    spots[1].place = Some(Place {
        point: Vec3::new(f32::NAN, 0.0, 1.0),
        path_m: 1.0,
    });
    says(
        &Capture {
            spots: &spots,
            ..good
        },
        "spots[1].place.point",
    );
    spots[1].place = Some(Place {
        point: Vec3::new(0.0, 0.0, 1.0),
        path_m: -1.0,
    });
    says(
        &Capture {
            spots: &spots,
            ..good
        },
        "spots[1].place.path_m",
    );
    let gate = |start_m, bin_width_m, bins| Gate {
        start_m,
        bin_width_m,
        bins,
    };
    for (gate, what) in [
        (gate(f64::NAN, 0.0384, 480), "gate.start_m"),
        (gate(1.0, 0.0, 480), "gate.bin_width_m"),
        (gate(1.0, 0.0384, 2), "gate.bins"),
    ] {
        says(&Capture { gate, ..good }, what);
    }
    let mut camera = room.camera;
    camera.intrinsics.fx = 0.0;
    says(
        &Capture {
            camera: &camera,
            ..good
        },
        "camera.intrinsics",
    );
    let laser = Vec3::new(f32::INFINITY, 0.0, 0.0);
    says(&Capture { laser, ..good }, "laser");
    let said = shadows_at(&good, &[1.0], &Settings::default()).unwrap_err();
    assert!(said.to_string().starts_with("depth_m"), "{said}");
}

#[test]
fn spots_without_any_return_are_no_calibration() {
    let mut room = Room::new(8, &grid(2), None);
    room.histogram.fill(0.0);
    let beams = room.beams(false);
    let found = demultiplex(&room.capture(&beams), &Settings::default());
    assert_eq!(found, Err(DemultiplexError::NoReturn { count: 4 }));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn anything_finite_gives_finite_answers(
        width in 1u32..6,
        height in 1u32..6,
        bins in 3u32..60,
        start in -5.0f64..5.0,
        bin in 0.001f64..0.5,
        values in prop::collection::vec(
            prop_oneof![Just(0.0f32), 0.0f32..1.0, any::<f32>().prop_filter("finite", |x| x.is_finite())], 1..64),
        spots in prop::collection::vec(
            ((-3.0f32..3.0, -3.0f32..3.0, -3.0f32..3.0), any::<bool>(), 0.0f32..9.0), 1..6),
    ) {
        let camera = Camera {
            intrinsics: Intrinsics::from_fov(90.0, width, height),
            origin: Vec3::ZERO,
            right: Vec3::new(1.0, 0.0, 0.0),
            down: Vec3::new(0.0, 1.0, 0.0),
            forward: Vec3::new(0.0, 0.0, 1.0),
        };
        let count = (width * height * bins) as usize;
        let histogram: Vec<f32> = (0..count).map(|k| values[k % values.len()]).collect();
        let spots: Vec<Spot> = spots
            .iter()
            .map(|((x, y, z), known, path_m)| {
                let direction = Vec3::new(*x, *y, z.abs() + 0.1);
                Spot {
                    direction,
                    place: known.then_some(Place { point: direction, path_m: *path_m }),
                }
            })
            .collect();
        let capture = Capture {
            histogram: &histogram,
            gate: Gate { start_m: start, bin_width_m: bin, bins },
            camera: &camera,
            laser: Vec3::ZERO,
            spots: &spots,
        };
        match demultiplex(&capture, &Settings::default()) {
            Err(e) => {
                let no_return = matches!(e, DemultiplexError::NoReturn { .. });
                prop_assert!(no_return, "{}", e);
            }
            Ok(found) => {
                for image in [&found.depth_m, &found.confidence, &found.lit, &found.albedo] {
                    prop_assert!(image.iter().all(|x| x.is_finite()));
                }
                prop_assert!(found.lit.iter().all(|x| (0.0..=1.0).contains(x)));
                prop_assert!(found.depth_m.iter().all(|z| *z > 0.0));
                prop_assert!(found.normals.iter().all(|n| n.is_finite()));
            }
        }
    }
}
