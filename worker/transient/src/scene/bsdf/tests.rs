//! Tests the laws of scattering: energy, reciprocity, densities, and limits in f32.

use picofarm_scene::{Bsdf, Distribution, Material};

use super::*;
use crate::numeric::{frame::frame, rng::Stream};

const ALPHAS: [f32; 5] = [0.001, 0.01, 0.1, 0.4, 1.0];
/// Angles of incidence from the normal, radians: normal to grazing.
const ANGLES: [f32; 5] = [0.0, 0.7, 1.2, 1.5, 1.569];

fn material(bsdf: Bsdf) -> Surface {
    Surface::new(&Material {
        bsdf,
        ..Material::diffuse("", [1.0; 3])
    })
}

fn lambert(reflectance: f32) -> Surface {
    material(Bsdf::Diffuse { reflectance })
}

fn conductor(alpha: f32, distribution: Distribution) -> Surface {
    material(Bsdf::RoughConductor {
        alpha,
        distribution,
        reflectance: 1.0,
    })
}

fn mix(alpha: f32, distribution: Distribution, weight: f32) -> Surface {
    material(Bsdf::Mixed {
        reflectance: 1.0,
        alpha,
        distribution,
        specular_reflectance: 1.0,
        weight,
    })
}

/// Returns every kind of surface, lossless.
fn all() -> Vec<Surface> {
    let mut surfaces = vec![lambert(1.0)];
    for alpha in ALPHAS {
        for d in [Distribution::Beckmann, Distribution::Ggx] {
            surfaces.push(conductor(alpha, d));
            surfaces.push(mix(alpha, d, 0.3));
        }
    }
    surfaces
}

fn normal_and_incident(angle: f32) -> (Vec3, Vec3) {
    let n = Vec3::new(0.2, -0.5, 0.8).normalized();
    let (t, b) = frame(n);
    let i = n * libm::cosf(angle) + (t * 0.6 + b * 0.8) * libm::sinf(angle);
    (n, i.normalized())
}

/// Returns the mean weight over samples, which is the albedo.
fn albedo(s: &Surface, angle: f32, count: u32) -> f64 {
    let (n, i) = normal_and_incident(angle);
    let mut rng = Rng::new(1, Stream::Paths, 0, 0);
    let draws = (0..count).filter_map(|_| s.sample(n, i, &mut rng));
    draws.map(|(_, w, _)| f64::from(w)).sum::<f64>() / f64::from(count)
}

#[test]
fn a_surface_fits_sixteen_bytes() {
    assert_eq!(size_of::<Surface>(), 16);
}

#[test]
fn sampling_weights_agree_with_density() {
    for s in all() {
        for angle in [0.1, 0.7, 1.2] {
            let (n, i) = normal_and_incident(angle);
            let mut rng = Rng::new(1, Stream::Paths, 0, 0);
            for _ in 0..4000 {
                if let Some((o, w, pdf)) = s.sample(n, i, &mut rng) {
                    let expected = s.scatter(n, i, o) / pdf;
                    assert!((w - expected).abs() < 2e-2 * w, "{s:?} {w} {expected}");
                    assert!((s.pdf(n, i, o) - pdf).abs() <= 1e-2 * pdf, "{s:?}");
                }
            }
        }
    }
}

#[test]
fn no_surface_gives_back_more_than_it_gets() {
    for s in all() {
        for angle in ANGLES {
            // Walter's G₁ is an approximation.
            let found = albedo(&s, angle, 20_000);
            assert!(found < 1.005, "{s:?} at {angle}: {found}");
        }
    }
}

#[test]
fn near_mirrors_keep_all_energy_and_rough_ones_most() {
    for d in [Distribution::Beckmann, Distribution::Ggx] {
        assert!(albedo(&conductor(0.01, d), 0.7, 20_000) > 0.99);
        assert!(albedo(&conductor(0.4, d), 0.0, 20_000) > 0.78);
    }
}

#[test]
fn the_albedo_by_sampling_is_that_by_quadrature() {
    for s in [
        conductor(0.4, Distribution::Ggx),
        conductor(1.0, Distribution::Ggx),
        conductor(0.4, Distribution::Beckmann),
        mix(0.3, Distribution::Ggx, 0.6),
        mix(0.3, Distribution::Beckmann, 0.6),
    ] {
        for angle in [0.0, 0.8, 1.3] {
            let (n, i) = normal_and_incident(angle);
            let (sum, density) = over_hemisphere(n, |o| [s.scatter(n, i, o), s.pdf(n, i, o)]);
            let sampled = albedo(&s, angle, 60_000);
            assert!((sum - sampled).abs() < 0.015, "{s:?} {sum} {sampled}");
            assert!(density < 1.005, "{s:?} at {angle}: pdf sums to {density}");
        }
    }
}

/// Returns the integrals of two functions over directions around `n`.
fn over_hemisphere(n: Vec3, f: impl Fn(Vec3) -> [f32; 2]) -> (f64, f64) {
    let (t, b) = frame(n);
    let (rows, columns) = (300, 600);
    let mut sums = [0.0f64; 2];
    for r in 0..rows {
        let z = (r as f32 + 0.5) / rows as f32;
        let flat = (1.0 - z * z).sqrt();
        for c in 0..columns {
            let phi = (c as f32 + 0.5) / columns as f32 * 2.0 * PI;
            let o = t * (flat * libm::cosf(phi)) + b * (flat * libm::sinf(phi)) + n * z;
            for (sum, x) in sums.iter_mut().zip(f(o.normalized())) {
                *sum += f64::from(x);
            }
        }
    }
    let cell = 2.0 * std::f64::consts::PI / f64::from(rows * columns);
    (sums[0] * cell, sums[1] * cell)
}

#[test]
fn scattering_is_reciprocal() {
    let n = Vec3::new(0.0, 1.0, 0.0);
    let a = Vec3::new(0.3, 1.0, 0.1).normalized();
    let b = Vec3::new(-0.4, 0.8, 0.2).normalized();
    for s in all() {
        let (ab, ba) = (s.scatter(n, a, b) / n.dot(b), s.scatter(n, b, a) / n.dot(a));
        assert!((ab - ba).abs() <= 1e-5 * ab, "{s:?}");
    }
}

#[test]
fn the_narrowest_lobe_at_the_flattest_angle_stays_finite() {
    for s in all() {
        for cos in [1e-7f32, 1e-5, 1e-3] {
            let n = Vec3::new(0.0, 0.0, 1.0);
            let i = Vec3::new(1.0, 0.0, cos).normalized();
            let mut rng = Rng::new(3, Stream::Paths, 1, 2);
            for _ in 0..2000 {
                if let Some((o, w, pdf)) = s.sample(n, i, &mut rng) {
                    assert!(
                        w.is_finite() && pdf.is_finite() && w >= 0.0,
                        "{s:?} {w} {pdf}"
                    );
                    let f = s.scatter(n, i, o);
                    assert!(f.is_finite() && f >= 0.0, "{s:?} {f}");
                }
            }
            let mirrored = Vec3::new(-i.x, 0.0, i.z);
            assert!(s.scatter(n, i, mirrored).is_finite() && s.pdf(n, i, mirrored).is_finite());
        }
    }
}

#[test]
fn lobes_drawn_at_random_make_up_the_mix() {
    let (n, i) = normal_and_incident(0.6);
    let (_, o) = normal_and_incident(-0.4);
    let s = mix(0.3, Distribution::Ggx, 0.4).scaled(0.8);
    let count = 1000;
    let mean = (0..count)
        .map(|k| s.lobe((k as f32 + 0.5) / count as f32))
        .inspect(|lobe| assert!(lobe.base == 0.0 && lobe.strength > 0.0))
        .map(|lobe| lobe.scatter(n, i, o))
        .sum::<f32>()
        / count as f32;
    assert!((mean / s.scatter(n, i, o) - 1.0).abs() < 1e-3);
    let pure = conductor(0.2, Distribution::Ggx);
    assert_eq!(pure.lobe(0.9), pure);
}

#[test]
fn a_mix_of_one_part_is_pure_and_black_is_black() {
    let ggx = Distribution::Ggx;
    let all_diffuse = mix(0.2, ggx, 0.0);
    assert_eq!(all_diffuse, lambert(1.0));
    assert_eq!(mix(0.2, ggx, 1.0), conductor(0.2, ggx));
    let black = mix(0.2, ggx, 0.5).black();
    let (n, i) = normal_and_incident(0.3);
    assert_eq!((black.strength, black.scatter(n, i, n)), (0.0, 0.0));
    let dark = material(Bsdf::Mixed {
        reflectance: 0.0,
        alpha: 0.1,
        distribution: ggx,
        specular_reflectance: 0.0,
        weight: 0.5,
    });
    assert_eq!(dark.strength, 0.0);
}

#[test]
fn conductors_agree_with_mitsuba() {
    // `roughconductor` of Mitsuba 3.9.1, material none, α = 0.4: BSDF times cosine.
    let n = Vec3::new(0.0, 0.0, 1.0);
    let i = Vec3::new(0.6, 0.0, 0.8);
    for (o, ggx, beckmann) in [
        ([-0.6, 0.0, 0.8], 0.595_203_3, 0.621_699),
        ([0.0, 0.5, 0.866_025_4], 0.158_562_5, 0.234_210_9),
        ([0.9, 0.0, 0.435_889_9], 0.031_095_876, 0.000_378_785_95),
    ] {
        for (d, expected) in [(Distribution::Ggx, ggx), (Distribution::Beckmann, beckmann)] {
            let found = conductor(0.4, d).scatter(n, i, Vec3::from(o));
            assert!(
                (found / expected - 1.0f32).abs() < 1e-4,
                "{d:?} {found} {expected}"
            );
        }
    }
}

#[test]
fn rough_surfaces_scatter_alike_by_factors_of_each_direction() {
    let mut rng = Rng::new(7, Stream::Paths, 0, 0);
    let n = Vec3::new(0.2, -0.5, 0.8).normalized();
    let mut compared = 0;
    for d in [Distribution::Beckmann, Distribution::Ggx] {
        for alpha in [0.15, 0.3, 0.8] {
            for s in [conductor(alpha, d), mix(alpha, d, 0.4)] {
                for _ in 0..200 {
                    let (Some((i, ci)), Some((o, co))) = (cosine(n, &mut rng), cosine(n, &mut rng))
                    else {
                        continue;
                    };
                    let (base, conductor) = s.arriving(co);
                    let (square, along2) = ((i + o).dot(i + o), (ci + co) * (ci + co));
                    let lobe = match d {
                        Distribution::Ggx => s.lobe_ggx(square, along2),
                        Distribution::Beckmann => s.lobe_beckmann(square, along2),
                    };
                    let (got, expected) = (
                        base + conductor * s.leaving(ci) * lobe,
                        s.scatter(n, i, o) / co,
                    );
                    let slack = 2e-3 * expected + 1e-6;
                    assert!(
                        (got - expected).abs() <= slack,
                        "{d:?} {alpha}: {got} {expected}"
                    );
                    compared += 1;
                }
            }
        }
    }
    assert!(compared > 2000);
}

#[test]
fn from_beneath_a_conductor_nothing_is_drawn() {
    let (n, _) = normal_and_incident(0.0);
    let (t, _) = frame(n);
    for alpha in ALPHAS {
        for d in [Distribution::Beckmann, Distribution::Ggx] {
            let s = conductor(alpha, d);
            for depth in [-1e-6f32, -1e-3, -0.1, -0.7, -1.0, f32::NAN] {
                let i = n * depth + t * (1.0 - depth * depth).sqrt();
                for seed in 0..20 {
                    let mut rng = Rng::new(seed, Stream::Paths, 0, 0);
                    assert_eq!(s.sample(n, i, &mut rng), None, "{alpha} {d:?} {depth}");
                }
            }
        }
    }
}
