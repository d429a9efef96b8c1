//! Near-mirrors, glossy surfaces and mixes: image laws, limits, and an independent path tracer.

use crate::common;

use std::f64::consts::PI;

use common::{
    beam_to,
    brute::{Brute, P},
    energy, framed, grey, multi_energy, near, ok, quad, scene, settings, v,
};
use picofarm_scene::{Bsdf, Distribution, Material, Scene, Vec3};
use picofarm_transient::{Budget, Gate, Rendered, Settings, trace_spots};

fn rough(alpha: f32, distribution: Distribution) -> Material {
    Material {
        bsdf: Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance: 1.0,
        },
        ..Material::mirror("rough", alpha)
    }
}

fn up_to(bounces: u32, passes: u32) -> Settings {
    Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 0.1,
            bins: 1000,
        },
        max_bounces: Some(bounces),
        ..settings(Budget::Samples(passes))
    }
}

/// Returns a floor of some material at `height`, a screen in front, and a spot on a plate to the
/// left at `above` the floor.
fn stage(m: Material, height: f32, above: f32, sees: Sees) -> Scene {
    let floor = quad(v(-1.5, height, 1.0), v(3.0, 0.0, 0.0), v(0.0, 0.0, -3.0), m);
    let screen = quad(
        v(-1.0, height, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(0.7),
    );
    // The plate is hardly wider than its spot, so light that returns to it does not count.
    let at = v(-1.5, height + above, -0.5);
    let plate = quad(
        at - v(0.0, 1e-3, 1e-3),
        v(0.0, 2e-3, 0.0),
        v(0.0, 0.0, 2e-3),
        grey(0.7),
    );
    let mut s = scene(vec![floor, screen, plate], 8, &[]);
    s.laser.beams.push(beam_to(at, v(1.0, 0.0, 0.0), 2));
    let low = height;
    s.camera = match sees {
        Sees::Screen => framed(
            Vec3::ZERO,
            v(-0.9, low + 1.0, -2.0),
            v(1.8, 0.0, 0.0),
            v(0.0, -0.95, 0.0),
            (8, 8),
        ),
        Sees::Floor => framed(
            Vec3::ZERO,
            v(-0.9, low, -1.8),
            v(1.8, 0.0, 0.0),
            v(0.0, 0.0, 1.5),
            (8, 8),
        ),
    };
    s
}

#[derive(Clone, Copy)]
enum Sees {
    Screen,
    Floor,
}

/// Returns the mean light on the screen from the spot's image below the floor.
fn by_image(s: &Scene, height: f32, above: f32) -> f64 {
    let brute = Brute::new(s);
    let image = P(-1.5, f64::from(height - above), -0.5);
    let (f, mut sum) = (0.7 / PI, 0.0);
    for k in 0..64 {
        brute.pixel(k % 8, k / 8, 8, |x, _| {
            let to = x.p - image;
            let d = to.length();
            sum += f * f * (to.0 / d) * (-to.2 / d) / (d * d) / 64.0;
        });
    }
    sum
}

#[test]
fn near_mirrors_in_grazing_light_give_the_images_light_and_no_more() {
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [0.01, 0.001] {
            for above in [0.3, 0.02] {
                let s = stage(rough(alpha, distribution), -0.6, above, Sees::Screen);
                let r = ok(&s, &up_to(3, 192));
                assert!(r.transient.iter().all(|h| h.is_finite() && *h >= 0.0));
                let (got, se) = multi_energy(&r);
                let expected = by_image(&s, -0.6, above);
                // GGX at 0.01 scatters some percent far away from the mirror direction, and all
                // distributions lose a little by masking.
                let what = format!("{distribution:?} {alpha} {above} m above");
                near(&what, got, expected, 0.03, se);
                assert!(
                    got < expected * 1.02 + 4.0 * se,
                    "more than a perfect mirror"
                );
            }
        }
    }
}

#[test]
fn a_mirror_seen_at_grazing_angles_shows_the_screen_behind_it() {
    // Three bounces: camera → floor → screen → spot. The camera is 2 cm above the floor.
    for (alpha, tolerance) in [(0.01, 0.1), (0.001, 0.02)] {
        let mut s = stage(Material::mirror("floor", alpha), -0.02, 0.4, Sees::Screen);
        // The screen's mirror image, from 2 cm to 50 cm below the floor.
        let (corner, right) = (v(-0.8, -0.06, -2.0), v(1.6, 0.0, 0.0));
        s.camera = framed(Vec3::ZERO, corner, right, v(0.0, -0.46, 0.0), (8, 8));
        let set = up_to(3, 256);
        let r = ok(&s, &set);
        assert!(r.transient.iter().all(|h| h.is_finite() && *h >= 0.0));
        let mut direct = s.clone();
        direct.objects[0] = quad(
            v(9.0, 9.0, 9.0),
            v(0.1, 0.0, 0.0),
            v(0.0, 0.1, 0.0),
            grey(0.0),
        );
        direct.objects[1] = quad(
            v(-1.0, -2.04, -2.0),
            v(2.0, 0.0, 0.0),
            v(0.0, 2.0, 0.0),
            grey(0.7),
        );
        let spot = direct.laser.beams[0].spot.as_mut().unwrap();
        spot.point.y = -0.42;
        let expected = energy(
            &ok(
                &direct,
                &Settings {
                    max_bounces: Some(2),
                    ..set
                },
            )
            .transient,
        );
        let (got, se) = multi_energy(&r);
        near(&format!("α {alpha}"), got, expected, tolerance, se);
    }
}

/// Returns a mirror on the floor at which a beam arrives, and a screen that it lights.
fn spot_on_mirror(alpha: f32, distribution: Distribution) -> Scene {
    let floor = quad(
        v(-1.0, -0.5, 1.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 0.0, -3.0),
        rough(alpha, distribution),
    );
    let screen = quad(
        v(-1.0, -0.5, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(0.7),
    );
    let side = quad(
        v(-1.0, -0.5, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -3.0),
        grey(0.7),
    );
    let mut s = scene(vec![floor, screen, side], 16, &[]);
    s.laser
        .beams
        .push(beam_to(v(0.1, -0.5, -1.0), v(0.0, 1.0, 0.0), 0));
    let (corner, right, down) = (v(-0.4, 0.4, -2.0), v(0.8, 0.0, 0.0), v(0.0, -0.8, 0.0));
    s.camera = framed(Vec3::ZERO, corner, right, down, (16, 16));
    s
}

#[test]
fn two_bounces_of_a_spot_on_a_mirror_match_the_integral_over_its_lobe() {
    for (alpha, distribution) in [
        (0.01, Distribution::Beckmann),
        (0.01, Distribution::Ggx),
        (0.05, Distribution::Beckmann),
    ] {
        let s = spot_on_mirror(alpha, distribution);
        let got = energy(&ok(&s, &up_to(2, 64)).transient);
        let brute = Brute::new(&s);
        let mut expected = 0.0;
        for k in 0..256 {
            brute.pixel(k % 16, k / 16, 48, |x, wo| {
                expected += brute.lit(x, wo, 0).0 / (48.0 * 48.0);
            });
        }
        near(
            &format!("{distribution:?} {alpha}"),
            got,
            expected,
            0.01,
            0.0,
        );
    }
}

#[test]
fn a_spot_on_a_mirror_lights_the_room_as_the_place_where_its_beam_goes_on() {
    // Seen on the wall at the left: mirror → screen → wall, compared with a spot on the screen.
    let mut s = spot_on_mirror(0.002, Distribution::Beckmann);
    let (corner, right, down) = (v(-1.0, 0.8, 0.0), v(0.0, 0.0, -1.5), v(0.0, -1.0, 0.0));
    s.camera = framed(Vec3::ZERO, corner, right, down, (8, 8));
    let r = ok(&s, &up_to(3, 512));
    let mut folded = s.clone();
    folded.laser.beams[0].spot = None;
    let spot = trace_spots(&folded).unwrap()[0].unwrap();
    assert!((spot.point - v(0.2, 0.0, -2.0)).length() < 1e-4, "{spot:?}");
    let expected = energy(&ok(&folded, &up_to(2, 64)).transient);
    let (got, se) = multi_energy(&r);
    near("folded", got, expected, 0.01, se);
}

#[test]
fn light_to_and_fro_between_two_facing_mirrors_is_that_of_the_rows_of_images() {
    // Mirrors at x = ±1, between a floor with a spot on it and a ceiling.
    let alpha = 0.01;
    let m = || Material::mirror("m", alpha);
    let wall = |x: f32| quad(v(x, -0.5, 4.0), v(0.0, 1.0, 0.0), v(0.0, 0.0, -8.0), m());
    let ceiling = quad(
        v(-1.0, 0.5, -4.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 0.0, 8.0),
        grey(0.7),
    );
    let at = v(0.3, -0.5, -0.8);
    let plate = quad(
        at - v(1e-3, 0.0, 1e-3),
        v(2e-3, 0.0, 0.0),
        v(0.0, 0.0, 2e-3),
        grey(0.7),
    );
    let mut s = scene(vec![wall(-1.0), wall(1.0), ceiling, plate], 8, &[]);
    s.laser.beams.push(beam_to(at, v(0.0, 1.0, 0.0), 3));
    let (corner, right, down) = (v(0.5, 0.5, -0.5), v(-1.0, 0.0, 0.0), v(0.0, 0.0, 1.0));
    s.camera = framed(Vec3::ZERO, corner, right, down, (8, 8));
    let brute = Brute::new(&s);
    let (f, mut expected) = (0.7 / PI, [0.0f64; 6]);
    for k in 0..64 {
        brute.pixel(k % 8, k / 8, 4, |x, _| {
            for (bounces, sum) in expected.iter_mut().enumerate().skip(2) {
                let n = bounces as f64 - 2.0;
                // n reflections, the first at the right or at the left wall.
                let turned = if bounces % 2 == 1 { -0.3 } else { 0.3 };
                let places = if n == 0.0 {
                    vec![0.3]
                } else {
                    vec![turned + 2.0 * n, turned - 2.0 * n]
                };
                for place in places {
                    let to = x.p - P(place, -0.5, f64::from(at.z));
                    let d = to.length();
                    *sum += f * f * (to.1 / d).powi(2) / (d * d) / 16.0;
                }
            }
        });
    }
    let mut before = 0.0;
    for bounces in 2..=5u32 {
        let r = ok(&s, &up_to(bounces, 512));
        let (got, se) = (energy(&r.transient), multi_energy(&r).1);
        let expected = expected[bounces as usize];
        println!(
            "{bounces} bounces: {:.4} ± {:.4} of the images' light",
            (got - before) / expected,
            se / expected
        );
        // Blur moves light across the ceiling in proportion to α and the path length, hence more
        // with every reflection.
        let tolerance = 0.01 * f64::from(bounces - 1);
        near(
            &format!("{bounces} bounces"),
            got - before,
            expected,
            tolerance,
            2.0 * se,
        );
        before = got;
    }
}

fn sees_and_bounces() -> [(Sees, u32); 3] {
    // Two bounces on the floor; floor then screen; screen then floor.
    [(Sees::Floor, 2), (Sees::Screen, 3), (Sees::Floor, 3)]
}

fn parts(r: &Rendered, bounces: u32) -> (f64, f64) {
    if bounces == 2 {
        return (energy(&r.split.as_ref().unwrap().two), 0.0);
    }
    multi_energy(r)
}

#[test]
fn an_even_mix_gives_the_mean_of_its_parts() {
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [0.01f32, 0.3] {
            let mixed = |weight| Material {
                bsdf: Bsdf::Mixed {
                    reflectance: 0.7,
                    alpha,
                    distribution,
                    specular_reflectance: 0.9,
                    weight,
                },
                ..grey(0.7)
            };
            for (sees, bounces) in sees_and_bounces() {
                let run = |weight: f32| {
                    let s = stage(mixed(weight), -0.6, 0.5, sees);
                    parts(&ok(&s, &up_to(bounces, 192)), bounces)
                };
                let ((a, sa), (b, sb), (m, sm)) = (run(0.0), run(1.0), run(0.5));
                let what = format!("{distribution:?} {alpha}, {bounces} bounces");
                // Two bounces have no separate error here.
                let se = sm.hypot(0.5 * sa.hypot(sb));
                near(&what, m, 0.5 * (a + b), 0.004, se);
            }
        }
    }
}

#[test]
fn beckmann_and_ggx_near_mirrors_agree_as_alpha_goes_to_nothing() {
    let run = |alpha, distribution| {
        let s = stage(rough(alpha, distribution), -0.6, 0.5, Sees::Screen);
        multi_energy(&ok(&s, &up_to(3, 256)))
    };
    for (alpha, tolerance) in [(0.01, 0.02), (0.001, 0.003)] {
        let (a, sa) = run(alpha, Distribution::Beckmann);
        let (b, sb) = run(alpha, Distribution::Ggx);
        near(&format!("α {alpha}"), b, a, tolerance, sa.hypot(sb));
    }
}

#[test]
fn glossy_surfaces_agree_with_brute_force_quadrature_and_path_tracing() {
    for distribution in [Distribution::Beckmann, Distribution::Ggx] {
        for sees in [Sees::Floor, Sees::Screen] {
            let mut s = stage(rough(0.3, distribution), -0.6, 0.5, sees);
            // A wall at the right adds longer paths.
            s.objects.push(quad(
                v(1.0, -0.6, 1.0),
                v(0.0, 2.0, 0.0),
                v(0.0, 0.0, -3.0),
                grey(0.7),
            ));
            let brute = Brute::new(&s).trace(4, 300_000, 7);
            let (mut before, mut se_before) = (0.0, 0.0);
            // (The last bounce by itself is the difference of two renders, which is noisy.)
            for bounces in 2..=4 {
                let r = ok(&s, &up_to(bounces, 192));
                let (all, se) = (energy(&r.transient), multi_energy(&r).1);
                let (expected, noise) = brute[bounces as usize];
                let what = format!("{distribution:?}, bounce {bounces}");
                let noise = (64.0 * noise).hypot(se.hypot(se_before));
                near(&what, all - before, 64.0 * expected, 0.002, noise);
                assert!(noise < 0.3 * expected * 64.0, "{what}: ± {noise}");
                (before, se_before) = (all, se);
            }
        }
    }
}
