//! The size of a scene does not matter: a room of one eighth gives the same mesh at one eighth.

use crate::common;

use common::{measured, room, small};
use picofarm_reconstruct::{
    Agreement, Measured, MeasuredSpot, Reconstructed, Unwatched, Verdict, reconstruct,
    source::{Certainty, weigh},
    surface,
};
use picofarm_scene::{Vec3, plato::PlatoObject};

const EIGHTH: f32 = 0.125;

fn chair() -> Measured {
    let (scene, rendered) = room(PlatoObject::Chair, 9, 64);
    measured(&scene, &rendered)
}

/// Returns the same measurements with all lengths multiplied.
fn resized(of: &Measured, factor: f32) -> Measured {
    let mut camera = of.camera;
    camera.origin = camera.origin * factor;
    let all = |metres: &[f32]| metres.iter().map(|m| m * factor).collect();
    let spot = |spot: &MeasuredSpot| MeasuredSpot {
        point: spot.point * factor,
        path_m: spot.path_m * factor,
        ..*spot
    };
    Measured {
        camera,
        laser: of.laser * factor,
        spots: of.spots.iter().map(spot).collect(),
        tau: all(&of.tau),
        unlit_range_m: all(&of.unlit_range_m),
        bin_width_m: of.bin_width_m * factor,
        ..of.clone()
    }
}

/// Returns the bits of everything that has a length, divided by the factor of the lengths.
fn bits(made: &Reconstructed, factor: f32) -> Vec<u32> {
    let mesh = surface(&made.field);
    let of_vec = |x: &Vec3| [x.x, x.y, x.z];
    let spots = made.measured.spots.iter();
    let lengths = mesh.positions.iter().flat_map(of_vec);
    let lengths = lengths.chain(made.depth.range.iter().copied());
    let lengths = lengths.chain(made.depth.error.iter().copied());
    let lengths = lengths.chain(made.planes.iter().map(|p| p.offset));
    let lengths = lengths.chain(spots.flat_map(|s| [s.point.x, s.point.y, s.point.z, s.path_m]));
    let lengths = lengths.chain(made.agreement.spots_off_surface_m);
    let lengths = lengths.chain(made.agreement.time_residual_m);
    let lengths = lengths.chain([made.field.spacing]).map(|m| m / factor);
    let logits = made.field.logit.iter().copied();
    lengths.chain(logits).map(f32::to_bits).collect()
}

#[test]
fn a_small_room_gives_the_same_mesh_but_smaller() {
    let large = chair();
    let whole = reconstruct(large.clone(), small(), &Unwatched).unwrap();
    assert!(whole.planes.len() >= 4, "{:?}", whole.planes);
    for factor in [EIGHTH, 0.25, 16.0] {
        let input = resized(&large, factor);
        let made = reconstruct(input, small(), &Unwatched).unwrap();
        assert_eq!(made.planes.len(), whole.planes.len(), "factor {factor}");
        assert_eq!(made.agreement.verdict, whole.agreement.verdict);
        assert!(
            bits(&made, factor) == bits(&whole, 1.0),
            "factor {factor}: other bits"
        );
    }
}

#[test]
fn pixels_that_no_spot_lights_are_placed_alike() {
    // A quarter of the image is dark.
    let mut large = chair();
    let pixels = large.pixels();
    for q in 0..large.lit.len() {
        let (u, v) = (q % pixels % 64, q % pixels / 64);
        if (20..30).contains(&u) && (10..22).contains(&v) {
            (large.lit[q], large.tau[q]) = (0, 0.0);
        }
    }
    let beams: Vec<u32> = large.spots.iter().map(|s| s.beam as u32).collect();
    let placed = |factor: f32| {
        let mut of = resized(&large, factor);
        let lit: Vec<f32> = of.lit.iter().map(|l| f32::from(*l)).collect();
        let sure = Certainty {
            lit: &lit,
            confidence: &vec![1.0; pixels],
            range: &vec![3.0 * factor; pixels],
        };
        weigh(&mut of, &beams, &sure).unwrap();
        let ranges = of.unlit_range_m.iter().map(|m| (m / factor).to_bits());
        ranges.collect::<Vec<_>>()
    };
    let whole = placed(1.0);
    assert!(whole.iter().any(|m| f32::from_bits(*m).is_finite()));
    assert!(placed(EIGHTH) == whole);
}

#[test]
fn small_scenes_have_small_limits() {
    // Spots 5 cm off the surfaces of a small box are as wrong as 40 cm in a room.
    let large = chair();
    let range = reconstruct(large.clone(), small(), &Unwatched)
        .unwrap()
        .depth
        .range;
    let off = |metres: f32, factor: f32| {
        let mut moved = resized(&large, factor);
        for spot in &mut moved.spots {
            spot.point = spot.point - spot.direction * (metres * factor);
        }
        let range: Vec<f32> = range.iter().map(|r| r * factor).collect();
        let found = Agreement::of_depths(&moved, &range, false);
        let off_m = found.spots_off_surface_m.unwrap();
        (found.verdict, off_m / factor, found.reasons)
    };
    let metres = [0.0, 0.25, 0.5, 1.0];
    let doubtful = metres.map(|m| {
        let (room, small) = (off(m, 1.0), off(m, EIGHTH));
        assert_eq!((room.0, room.1), (small.0, small.1), "{m} m");
        let said = format!("{:.3} m off the surfaces", EIGHTH * small.1);
        let stated = small.2.iter().any(|r| r.contains(&said));
        assert_eq!(stated, small.0 == Verdict::Doubtful, "{m} m: {:?}", small.2);
        small.0 == Verdict::Doubtful
    });
    assert!(!doubtful[0] && doubtful[3], "{doubtful:?}");
}
