//! Partly sensitive pixels, compared with images of smaller, fully sensitive pixels.

use crate::common;

use common::{energy, grey, ok, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Bsdf, Distribution, Material, Scene};
use picofarm_transient::{Budget, Optics, Rendered, Settings, render};

/// Returns a room with a near-mirror on its right wall, a ball in front of it, and a spot next to
/// the floor.
fn furnished(size: u32) -> Scene {
    let mirror = Material {
        bsdf: Bsdf::RoughConductor {
            reflectance: 0.9,
            alpha: 0.01,
            distribution: Distribution::Ggx,
        },
        ..grey(0.9)
    };
    let mut objects = room(v(-1.5, -1.2, -3.0), v(1.5, 1.2, 1.0), &grey(0.6));
    objects.push(quad(
        v(1.45, -0.5, -2.6),
        v(0.0, 0.0, 1.4),
        v(0.0, 1.1, 0.0),
        mirror,
    ));
    objects.push(sphere(v(-0.4, -0.6, -2.0), 0.35, 3, grey(0.4)));
    let spots = [
        v(0.31, 0.22, -1.0),
        v(-0.52, -0.41, -1.0),
        v(0.05, -0.415, -1.03),
    ];
    scene(objects, size, &spots)
}

fn set(fill_factor: f64, samples: u32, seed: u64) -> Settings {
    Settings {
        optics: Optics {
            fill_factor,
            ..Optics::default()
        },
        seed,
        ..settings(Budget::Samples(samples))
    }
}

/// Returns the energy by pixel.
fn by_pixel(r: &Rendered, of: impl Fn(&Rendered) -> &[f32]) -> Vec<f64> {
    of(r).chunks(r.gate.bins as usize).map(energy).collect()
}

#[test]
fn a_pixel_is_the_mean_of_the_finer_pixels_in_its_sensitive_square() {
    const SIDE: usize = 8;
    const SEEDS: u64 = 6;
    let (coarse, fine) = (furnished(SIDE as u32), furnished(4 * SIDE as u32));
    let two = |r: &Rendered| by_pixel(r, |r| &r.split.as_ref().expect("parts").two);
    let multi = |r: &Rendered| by_pixel(r, |r| &r.split.as_ref().expect("parts").multi);
    // The sensitive quarter of the area is the middle 2x2 of 4x4 small pixels.
    let middle = |all: Vec<f64>| -> Vec<f64> {
        let of = |k: usize| {
            let (row, col) = (4 * (k / SIDE) + 1, 4 * (k % SIDE) + 1);
            let at = |r: usize, c: usize| all[(row + r) * 4 * SIDE + col + c];
            (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1)) / 4.0
        };
        (0..SIDE * SIDE).map(of).collect()
    };
    let (mut a, mut b) = (vec![], vec![]);
    for seed in 0..SEEDS {
        let r = ok(&coarse, &set(0.25, 128, seed));
        a.push([two(&r), multi(&r)]);
        let r = ok(&fine, &set(1.0, 32, 100 + seed));
        b.push([middle(two(&r)), middle(multi(&r))]);
    }
    let whole = ok(&coarse, &set(1.0, 64, 1));
    let whole = [two(&whole), multi(&whole)];
    let mut apart = 0;
    for part in 0..2 {
        let mut worst = 0.0f64;
        for k in 0..SIDE * SIDE {
            let moments = |all: &[[Vec<f64>; 2]]| {
                let n = all.len() as f64;
                let mean = all.iter().map(|x| x[part][k]).sum::<f64>() / n;
                let square = all.iter().map(|x| (x[part][k] - mean).powi(2)).sum::<f64>();
                (mean, square / (n - 1.0) / n)
            };
            let ((x, vx), (y, vy)) = (moments(&a), moments(&b));
            let error = (vx + vy).sqrt().max(2e-3 * y);
            worst = worst.max((x - y).abs() / error);
            // Student's t with 10 degrees of freedom, 64 pixels.
            assert!(
                (x - y).abs() < 6.0 * error,
                "part {part}, pixel {k}: {x} {y} ± {error}"
            );
            apart += usize::from((whole[part][k] - y).abs() > 6.0 * error);
        }
        eprintln!("part {part}: worst {worst:.1} standard errors");
    }
    // Fully sensitive pixels differ, so the test can detect a difference.
    assert!(apart > 20, "{apart}");
}

#[test]
fn a_spot_is_seen_where_it_falls_onto_the_sensitive_square_and_is_the_brighter_the_smaller_that_is()
{
    let one = |fill_factor, x: f32| {
        let wall = quad(
            v(-9.0, -9.0, -2.0),
            v(18.0, 0.0, 0.0),
            v(0.0, 18.0, 0.0),
            grey(0.5),
        );
        // Pixels are a quarter wide, at unit distance.
        let s = scene(vec![wall], 8, &[v(x, 0.125, -1.0)]);
        let set = Settings {
            max_bounces: Some(1),
            one_bounce: true,
            split: false,
            ..set(fill_factor, 2, 1)
        };
        energy(&ok(&s, &set).transient)
    };
    let all = one(1.0, 0.125);
    assert!((one(0.25, 0.125) / all - 4.0).abs() < 1e-5);
    // Half the side is sensitive: 0.0625 to either side of the middle.
    assert!(one(0.25, 0.185) > 0.0);
    assert_eq!(one(0.25, 0.19), 0.0);
    assert!(one(1.0, 0.19) > 0.0);
}

#[test]
fn a_share_that_is_none_is_refused() {
    for share in [0.0, -0.5, 1.5, f64::NAN] {
        let error = render(&furnished(4), &set(share, 2, 1), &common::Quiet).unwrap_err();
        assert!(error.to_string().contains("fill_factor"), "{error}");
    }
}
