//! Properties that the independent tracer must have with glass: closed forms, and reciprocity of
//! camera and light.

use crate::common;

use std::f64::consts::PI;

use common::{
    bent::{Connects, Ends},
    brute::{Noise, P},
    compare::{BATCHES, PARTS, regions},
    glass::{Draw, fresnel, pane},
    glassware::{body, cuboid, thin},
    grey,
    light::{Energy, LONGEST, Source, Tracer, frame},
    near, quad, room, scene, sphere, v,
};
use picofarm_scene::{Bsdf, Camera, Intrinsics, Scene, Vec3};
use rayon::prelude::*;

/// The mean over directions, weighted by their cosines. For light from air, it must equal Walsh's
/// closed form. From within, outgoing and incoming radiance over the square of the index must be
/// equal.
#[test]
fn the_tracers_reflectances_are_those_of_closed_forms() {
    let mean = |from: f64, to: f64| -> f64 {
        let n = 2_000_000;
        let at = |k: i32| (f64::from(k) + 0.5) / f64::from(n);
        let part = |k| fresnel(from, to, at(k)).iter().sum::<f64>() * at(k);
        (0..n).map(part).sum::<f64>() / f64::from(n)
    };
    for n in [1.2f64, 1.5, 2.0] {
        let (p, m, q) = (n * n + 1.0, n * n - 1.0, n.powi(4) - 1.0);
        let walsh = 0.5
            + (n - 1.0) * (3.0 * n + 1.0) / (6.0 * (n + 1.0).powi(2))
            + n.powi(2) * m.powi(2) / p.powi(3) * ((n - 1.0) / (n + 1.0)).ln()
            - 2.0 * n.powi(3) * (n * n + 2.0 * n - 1.0) / (p * q)
            + 8.0 * n.powi(4) * (n.powi(4) + 1.0) / (p * q * q) * n.ln();
        near("from air", mean(1.0, n), walsh, 1e-5, 0.0);
        let within = 1.0 - (1.0 - walsh) / (n * n);
        near("from within", mean(n, 1.0), within, 1e-5, 0.0);
    }
    for cos in [1.0, 0.7, 0.3, 0.05] {
        let clear = pane(thin(1.5, 1.0, false).bsdf, cos, true);
        near("pane", clear.passes + clear.reflects, 1.0, 1e-9, 0.0);
        let tinted = pane(thin(1.7, 0.5, false).bsdf, cos, false);
        let sums = fresnel(1.0, f64::from(1.7f32), cos).map(|r| {
            let back = 0.25 * r * (1.0 - r) / (1.0 + r);
            [0.25 * (1.0 - r) / (1.0 + r), 0.5 * (r + back)]
        });
        near("passes", tinted.passes, sums[0][0] + sums[1][0], 1e-9, 0.0);
        near(
            "reflects",
            tinted.reflects,
            sums[0][1] + sums[1][1],
            1e-9,
            0.0,
        );
    }
}

/// A block offsets a ray, preserves its direction, and delays it: closed forms. The fraction that
/// passes without reflection is (1 − F)².
#[test]
fn the_tracers_rays_pass_a_block_of_glass_in_parallel() {
    let block = cuboid(v(0.0, 0.0, -2.0), v(3.0, 3.0, 0.5), 0.0, body(1.5, 1.0));
    let wall = quad(
        v(-9.0, -9.0, -4.0),
        v(18.0, 0.0, 0.0),
        v(0.0, 18.0, 0.0),
        grey(0.5),
    );
    let tracer = Tracer::new(&scene(vec![block, wall], 8, &[]));
    let d = P(0.6, 0.1, -1.0).unit();
    let cos = -d.2;
    let sin2 = 1.0 - cos * cos;
    let inside = (1.0 - sin2 / 2.25).sqrt();
    let mut rng = Noise(1);
    let aside = sin2.sqrt() * (3.0 / cos + 1.0 / (1.5 * inside));
    let (mut passed, many) = (0, 100_000);
    for _ in 0..many {
        let start = (P(0.0, 0.0, 0.0), d);
        let leg = tracer.leg(start, 1.0, Draw::CAMERA, &mut rng);
        let Some(leg) = leg.filter(|leg| leg.reflections == 0) else {
            continue;
        };
        passed += 1;
        let at = P(d.0, d.1, 0.0).unit() * aside + P(0.0, 0.0, -4.0);
        assert!((leg.end.p - at).length() < 1e-7, "{:?}", leg.end.p);
        assert!((leg.d - d).length() < 1e-12 && leg.bent);
        assert!((leg.weight - 1.0).abs() < 1e-12 && leg.index == 1.0);
        let length = 3.0 / cos + 1.5 / inside;
        assert!((leg.length - length).abs() < 1e-7, "{}", leg.length);
    }
    let f = fresnel(1.0, 1.5, cos).iter().sum::<f64>() / 2.0;
    let share = (1.0 - f).powi(2);
    let se = (share * (1.0 - share) / f64::from(many)).sqrt();
    let got = f64::from(passed) / f64::from(many);
    near("what passes a block", got, share, 0.0, se);
}

/// Untinted glass absorbs no light.
#[test]
fn all_light_of_the_tracer_arrives_past_clear_glass() {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    objects.push(quad(
        v(-1.0, -1.0, -3.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        thin(1.5, 1.0, false),
    ));
    objects.push(sphere(v(-0.5, 0.2, -1.5), 0.4, 3, body(1.5, 1.0)));
    let tracer = Tracer::new(&scene(objects, 8, &[]));
    let source = spot(P(0.5, 1.5, -2.0), P(0.0, -1.0, 0.0));
    let mut rng = Noise(3);
    let batches: Vec<[f64; 2]> = (0..BATCHES)
        .map(|_| {
            let mut sums = [0.0; 2];
            tracer.arrivals(&source, (10_000, LONGEST), Draw::LIGHT, &mut rng, |a| {
                sums[usize::from(a.bends.first)] += a.flux;
                false
            });
            sums
        })
        .collect();
    let part = |k: usize| Energy::of(&batches.iter().map(|b| b[k]).collect::<Vec<_>>());
    assert!(part(1).mean > 0.03, "some of it is bent");
    let whole = Energy::of(&batches.iter().map(|b| b[0] + b[1]).collect::<Vec<_>>());
    near("what arrives", whole.mean, 1.0, 1e-9, whole.se);
}

/// A patch within a ball of glass and one outside. The light that travels from one to the other
/// must equal the result from the camera's side, with its factors for radiance in glass.
#[test]
fn the_tracer_carries_light_and_radiance_alike() {
    let patch = quad(
        v(-0.25, -0.25, -2.125),
        v(0.5, 0.0, 0.125),
        v(0.0, 0.5, 0.0),
        grey(0.5),
    );
    let wall = quad(
        v(-1.0, -1.0, -1.0),
        v(0.0, 2.0, 0.0),
        v(2.0, 0.0, 0.0),
        grey(0.5),
    );
    let ball = sphere(v(0.0, 0.0, -2.0), 0.5, 3, body(1.5, 0.9));
    let tracer = Tracer::new(&scene(vec![patch, wall, ball], 8, &[]));
    let corners = [
        [
            P(-0.25, -0.25, -2.125),
            P(0.5, 0.0, 0.125),
            P(0.0, 0.5, 0.0),
        ],
        [P(-1.0, -1.0, -1.0), P(0.0, 2.0, 0.0), P(2.0, 0.0, 0.0)],
    ];
    let mut rng = Noise(5);
    let mut carried = |from: usize, index: f64, draw: Draw| {
        let [corner, a, b] = corners[from];
        let across = a.cross(b);
        let n = across.unit();
        let (t, u) = frame(n);
        let target = plane(corners[1 - from]);
        let all: Vec<f64> = (0..BATCHES)
            .map(|_| {
                let many = 60_000;
                let one = |_| {
                    let p = corner + a * rng.next() + b * rng.next();
                    let (angle, r2) = (2.0 * PI * rng.next(), rng.next());
                    let around = t * angle.cos() + u * angle.sin();
                    let w = around * r2.sqrt() + n * (1.0 - r2).sqrt();
                    let leg = tracer.leg((p, w), index, draw, &mut rng);
                    leg.map_or(0.0, |leg| {
                        let there = (leg.end.p - target.0).dot(target.1).abs() < 1e-6;
                        if there && leg.end.front {
                            leg.weight
                        } else {
                            0.0
                        }
                    })
                };
                (0..many).map(one).sum::<f64>() / f64::from(many) * across.length()
            })
            .collect();
        Energy::of(&all)
    };
    let light = carried(0, 1.5, Draw::LIGHT);
    let radiance = carried(1, 1.0, Draw::CAMERA);
    let se = light.se.hypot(radiance.se);
    near("radiance against light", radiance.mean, light.mean, 0.0, se);
}

/// Returns a point of a patch and the patch's normal.
fn plane([corner, a, b]: [P; 3]) -> (P, P) {
    (corner, a.cross(b).unit())
}

/// Returns a source that scatters all its light as a Lambertian surface does.
fn spot(p: P, n: P) -> Source {
    Source {
        p,
        n,
        back: n,
        bsdf: Bsdf::Diffuse { reflectance: 1.0 },
    }
}

/// Swaps camera and source. Returns energies of `[bent at the camera][bent at the source][part]`
/// for a camera that weights directions as a Lambertian surface does.
fn ends(scene: &Scene, camera: Camera, source: &Source) -> [[[Energy; 2]; 2]; 2] {
    let tracer = Tracer::new(&Scene {
        camera,
        ..scene.clone()
    });
    let i = tracer.scene.camera.intrinsics;
    let size = i.width as usize;
    let sources = [*source];
    let regions = regions(&tracer, &sources, Tracer::meets_glass);
    let likely: Vec<usize> = (0..regions.len()).filter(|&k| regions[k] == 2).collect();
    let weigh = |pixel: usize| {
        let at = ((pixel % size) as f64 + 0.5, (pixel / size) as f64 + 0.5);
        let w = tracer.ray(at);
        P::from(tracer.scene.camera.forward).dot(w) / tracer.pixels_per_steradian(w)
    };
    let batches: Vec<[[[f64; 2]; 2]; 2]> = (0..BATCHES)
        .into_par_iter()
        .map(|batch| {
            let mut rng = Noise(500 + batch);
            let mut all = [[[0.0; 2]; 2]; 2];
            tracer.carry(source, (200_000, LONGEST), &mut rng, |s| {
                let spot = usize::from(s.bends.first);
                all[0][spot][usize::from(s.more)] += s.value * weigh(s.pixel);
            });
            let connects = Connects::NearestToSpot;
            let lights = tracer.lights(&sources, 2_000, connects, &mut rng);
            let from = (&sources[..], &lights[..], connects);
            tracer.past_glass(from, &likely, 40_000, &mut rng, |found| {
                let part = usize::from(found.more);
                let both = match found.ends {
                    Ends::Camera => 0,
                    Ends::Both => 1,
                    // Found from neither side.
                    Ends::All => return,
                };
                all[1][both][part] += found.value * weigh(found.pixel);
            });
            all
        })
        .collect();
    let of = |c: usize, s: usize, part: usize| {
        Energy::of(&batches.iter().map(|b| b[c][s][part]).collect::<Vec<_>>())
    };
    [0, 1].map(|c| [0, 1].map(|s| [0, 1].map(|part| of(c, s, part))))
}

#[test]
fn camera_and_source_of_the_tracer_may_change_places() {
    let (o, x, y) = (v(-1.5, -1.5, -4.0), v(3.0, 0.0, 0.0), v(0.0, 3.0, 0.0));
    let z = v(0.0, 0.0, 2.0);
    let objects = vec![
        quad(o, x, y, grey(0.8)),
        quad(o, y, z, grey(0.7)),
        quad(o, z, x, grey(0.6)),
        sphere(v(-0.5, -0.5, -2.8), 0.5, 3, body(1.5, 0.9)),
        cuboid(v(0.8, -0.7, -3.0), v(0.3, 0.5, 0.3), 0.5, body(1.7, 1.0)),
        quad(
            v(-1.2, 0.1, -3.0),
            x * 0.8,
            v(0.0, 1.2, 0.4),
            thin(1.6, 0.9, false),
        ),
    ];
    let s = scene(objects, 8, &[]);
    let intrinsics = Intrinsics::from_fov(140.0, 300, 300);
    let places = [
        (Vec3::ZERO, v(0.0, 0.0, -1.0)),
        (v(0.9, 0.6, -0.4), v(-0.2, -0.1, -1.0)),
    ];
    let [a, b] = [(0, 1), (1, 0)].map(|(c, l)| {
        let camera = Camera::look_at(places[c].0, places[c].0 + places[c].1, intrinsics);
        let light = spot(places[l].0.into(), P::from(places[l].1).unit());
        ends(&s, camera, &light)
    });
    for (camera, of_source) in a.iter().enumerate() {
        for (source, parts) in of_source.iter().enumerate() {
            for (part, there) in parts.iter().enumerate() {
                let here = b[source][camera][part];
                if here.mean == 0.0 && there.mean == 0.0 {
                    continue;
                }
                let what = format!("bent at the ends {camera} {source}, {}", PARTS[part]);
                let se = here.se.hypot(there.se);
                println!(
                    "{what}: {:.4e} ± {:.1e}, {:.4e} ± {:.1e}",
                    there.mean, there.se, here.mean, here.se
                );
                near(&what, there.mean, here.mean, 1e-3, se);
            }
        }
    }
}
