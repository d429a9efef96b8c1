//! Doubtful pixels and undecided pairs of measurements that were separated from one flash.

use crate::common;

use common::{room, small};
use picofarm_reconstruct::{
    Measured, ReconstructError, Reconstructed, Unwatched, reconstruct,
    source::{Certainty, Given, Times, given, weigh},
};
use picofarm_scene::plato::PlatoObject;

const SIDE: usize = 64;
const SPOTS: usize = 8;

/// Returns whether a pixel is in a patch of a tenth of the image that shows a mirror's room.
fn in_patch(p: usize) -> bool {
    (p % SIDE) >= 40 && (p % SIDE) < 60 && (8..28).contains(&(p / SIDE))
}

fn sure<'a>(lit: &'a [f32], confidence: &'a [f32], range: &'a [f32]) -> Certainty<'a> {
    Certainty {
        lit,
        confidence,
        range,
    }
}

/// Returns PlatoNeRF's room, whose patch seems twice as far away as it is, with the confidence
/// there, and the true ranges.
fn mirrored(confidence: Option<f32>) -> (Measured, Vec<f32>) {
    let (scene, rendered) = room(PlatoObject::Chair, SPOTS, SIDE as u32);
    let truth = rendered.truth.range.clone();
    let range: Vec<f32> = truth
        .iter()
        .enumerate()
        .map(|(p, r)| if in_patch(p) { 2.0 * r } else { *r })
        .collect();
    let spots: Vec<_> = rendered
        .spots
        .iter()
        .map(|s| s.as_ref().map(|s| (s.point, s.path_m)))
        .collect();
    let beams: Vec<u32> = (0..SPOTS as u32).collect();
    let mut measured = given(&Given {
        camera: scene.camera,
        laser: scene.laser.origin,
        spots: &spots,
        beams: &beams,
        times: Times::Range(&range),
        lit: &rendered.truth.visibility,
        mirror: &vec![0; SIDE * SIDE],
    })
    .unwrap();
    if let Some(c) = confidence {
        let of = |p: usize| if in_patch(p) { c } else { 1.0 };
        let all: Vec<f32> = (0..SIDE * SIDE).map(of).collect();
        let lit: Vec<f32> = rendered
            .truth
            .visibility
            .iter()
            .map(|v| f32::from(*v))
            .collect();
        weigh(&mut measured, &beams, &sure(&lit, &all, &range)).unwrap();
    }
    (measured, truth)
}

/// Returns the reconstruction, and the mean error of the patch's depth in metres.
fn made(confidence: Option<f32>) -> (Reconstructed, f32) {
    let (measured, truth) = mirrored(confidence);
    let settings = picofarm_reconstruct::Settings {
        accept_inconsistent: true,
        ..small()
    };
    let made = reconstruct(measured, settings, &Unwatched).unwrap();
    let seen = |p: &usize| in_patch(*p) && made.depth.range[*p].is_finite();
    let off: Vec<f32> = (0..SIDE * SIDE)
        .filter(seen)
        .map(|p| (made.depth.range[p] - truth[p]).abs())
        .collect();
    let mean = off.iter().sum::<f32>() / off.len() as f32;
    (made, mean)
}

#[test]
fn a_doubtful_patch_behind_a_wall_neither_costs_the_wall_nor_stays_behind_it() {
    let (blind, lost) = made(None);
    let (sure, _) = made(Some(1.0));
    assert_eq!(sure.planes, blind.planes, "confidence of 1 changes nothing");
    assert!(lost > 1.0, "{lost} m");
    let (doubting, off) = made(Some(0.1));
    let wall = |of: &Reconstructed| {
        let is = |p: &picofarm_reconstruct::Plane| p.normal.x < -0.99 && p.offset < 2.1;
        of.planes.iter().any(is)
    };
    assert!(wall(&doubting), "{:?}", doubting.planes);
    assert!(wall(&blind), "{:?}", blind.planes);
    assert!(off < 0.1, "{off} m");
}

#[test]
fn undecided_pairs_are_left_unused_and_sizes_that_do_not_fit_are_named() {
    let (mut measured, _) = mirrored(None);
    let pixels = SIDE * SIDE;
    let beams: Vec<u32> = (0..SPOTS as u32).collect();
    let before = measured.used.clone();
    let mut lit = vec![0.9; SPOTS * pixels];
    lit[pixels..2 * pixels].fill(0.5);
    let ones = vec![1.0; pixels];
    weigh(&mut measured, &beams, &sure(&lit, &ones, &ones)).unwrap();
    for (k, used) in measured.used.chunks(pixels).enumerate() {
        let expected = match k {
            1 => vec![0; pixels],
            _ => before[k * pixels..][..pixels].to_vec(),
        };
        assert_eq!(used, expected, "spot {k}");
    }
    for (beams, lit, confidence, range, field) in [
        (&beams[..], &lit[1..], &lit[..pixels], &ones[..], "lit"),
        (&beams[..], &lit[..], &lit[..1], &ones[..], "confidence"),
        (&beams[..], &lit[..], &lit[..pixels], &ones[1..], "range"),
        (
            &beams[1..],
            &lit[pixels..],
            &lit[..pixels],
            &ones[..],
            "beams",
        ),
    ] {
        let refused = weigh(&mut measured, beams, &sure(lit, confidence, range)).unwrap_err();
        assert!(
            matches!(&refused, ReconstructError::Invalid { field: f, .. } if f == field),
            "{refused}"
        );
    }
}

#[test]
fn a_pixel_that_no_spot_lights_has_the_distance_of_the_flash_where_that_is_sure() {
    let (scene, rendered) = room(PlatoObject::Chair, SPOTS, SIDE as u32);
    let range = rendered.truth.range.clone();
    let pixels = SIDE * SIDE;
    let dark = in_patch;
    let mut lit: Vec<f32> = (rendered.truth.visibility.iter())
        .map(|v| f32::from(*v))
        .collect();
    for (q, lit) in lit.iter_mut().enumerate() {
        if dark(q % pixels) {
            *lit = 0.0;
        }
    }
    let spots: Vec<_> = (rendered.spots.iter())
        .map(|s| s.as_ref().map(|s| (s.point, s.path_m)))
        .collect();
    let beams: Vec<u32> = (0..SPOTS as u32).collect();
    let known = |confidence: f32| {
        let shifted: Vec<f32> = range.iter().map(|r| 0.8 * r).collect();
        let mut measured = given(&Given {
            camera: scene.camera,
            laser: scene.laser.origin,
            spots: &spots,
            beams: &beams,
            times: Times::Range(&range),
            lit: &lit.iter().map(|p| *p as u8).collect::<Vec<_>>(),
            mirror: &vec![0; pixels],
        })
        .unwrap();
        let all = vec![confidence; pixels];
        weigh(&mut measured, &beams, &sure(&lit, &all, &shifted)).unwrap();
        (0..pixels)
            .filter(|p| dark(*p) && (measured.unlit_range_m[*p] - shifted[*p]).abs() < 1e-6)
            .count()
    };
    let there = (0..pixels).filter(|p| dark(*p)).count();
    let [sure, unsure] = [1.0, 0.0].map(known);
    assert!(sure * 10 > there * 9, "{sure} of {there} pixels");
    assert_eq!(unsure, 0);
}
