//! Spots on edges and close to other surfaces: energy is conserved, and changes continuously as the
//! distance approaches zero.

use crate::common;

use std::f64::consts::PI;

use common::{
    Quiet, beam_to, black,
    brute::P,
    energy, framed, grey,
    light::{Start, Tracer},
    near, object, ok, quad, room, scene, settings, v,
};
use picofarm_scene::{Bsdf, Distribution, Material, Object, Scene, Vec3};
use picofarm_transient::{Budget, Gate, Part, PartOf, Settings, join_parts, render_part};

/// Light paths per reference.
const PATHS: usize = 120_000;

/// Returns the energies of exactly two bounces and of three and more, and the stated standard error
/// of their sum.
fn energies(s: &Scene) -> ([f64; 2], f64) {
    let gate = Gate {
        start_m: 0.0,
        bin_width_m: 4.0,
        bins: 100,
    };
    let set = Settings {
        gate,
        ..settings(Budget::Samples(128))
    };
    let r = ok(s, &set);
    let split = r.split.as_ref().unwrap();
    let se = f64::from(r.error.total_relative) * energy(&r.transient);
    ([energy(&split.two), energy(&split.multi)], se)
}

/// Renders with the spot stated in f32 and traces light from it in f64. Both must agree.
#[track_caller]
fn agrees(what: &str, s: &Scene, start: Start, paths: usize) {
    let (got, stated) = energies(s);
    let reference = Tracer::new(s).energies(0, start, paths, 7);
    for ((part, got), expected) in ["two", "multi"].into_iter().zip(got).zip(reference) {
        let se = stated.hypot(expected.se);
        near(&format!("{what}, {part}"), got, expected.mean, 0.002, se);
        assert!(
            se < 0.012 * (got + reference[0].mean + reference[1].mean),
            "{what}, {part}: {se}"
        );
    }
}

fn grey_room() -> Vec<Object> {
    room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6))
}

/// Returns a room with a spot on its far wall, at distance `d` from the right wall (in f64, because
/// in f32 the spot may be on the edge).
fn beside_wall(objects: Vec<Object>, d: f64) -> (Scene, Start) {
    let mut s = scene(objects, 32, &[]);
    let p = v((2.0 - d) as f32, 0.3, -4.0);
    s.laser.beams.push(beam_to(p, v(0.0, 0.0, 1.0), 1));
    let start = Start {
        p: P(2.0 - d, f64::from(0.3f32), -4.0),
        n: P(0.0, 0.0, 1.0),
        object: 1,
    };
    (s, start)
}

#[test]
fn a_spot_beside_a_wall_has_the_energy_of_an_independent_tracer_at_any_distance() {
    for d in [1e-9, 1e-4, 1e-2, 6e-2, 0.15, 0.3] {
        let (s, start) = beside_wall(grey_room(), d);
        agrees(&format!("{d:e} m from the wall"), &s, start, PATHS);
    }
}

#[test]
fn a_beam_that_is_traced_to_an_edge_or_a_vertex_has_the_energy_beside_it() {
    // Spots on the edge of the far wall with the right one, on the edge of the ceiling with the
    // right wall, and on a vertex.
    for p in [v(2.0, 0.3, -4.0), v(2.0, 1.5, -3.0), v(2.0, 1.5, -4.0)] {
        let s = scene(grey_room(), 32, &[p]);
        let r = ok(&s, &settings(Budget::Samples(1)));
        let spot = r.spots[0].unwrap();
        let mut stated = s.clone();
        stated.laser.beams[0].spot = Some(spot);
        let inward = |low: f64, high: f64, at: f32, n: f32| match n {
            0.0 => f64::from(at).clamp(low + 1e-8, high - 1e-8),
            _ => f64::from(at).clamp(low, high),
        };
        let (p, n) = (spot.point, spot.normal);
        let start = Start {
            p: P(
                inward(-2.0, 2.0, p.x, n.x),
                inward(-1.5, 1.5, p.y, n.y),
                inward(-4.0, 1.0, p.z, n.z),
            ),
            n: n.into(),
            object: spot.object as usize,
        };
        agrees(&format!("{p:?}"), &stated, start, PATHS);
    }
}

#[test]
fn a_white_room_keeps_all_energy_at_every_bounce_of_a_spot_on_an_edge() {
    let (low, high) = (v(-1.2, -0.9, -1.5), v(1.0, 1.1, 0.8));
    let size = high - low;
    let (x, y, z) = (
        v(size.x, 0.0, 0.0),
        v(0.0, size.y, 0.0),
        v(0.0, 0.0, size.z),
    );
    let walls = [
        (v(low.x, high.y, low.z), x, -y),
        (v(high.x, high.y, high.z), -x, -y),
        (v(high.x, high.y, low.z), z, -y),
        (v(low.x, high.y, high.z), -z, -y),
        (low, x, z),
        (v(low.x, high.y, high.z), x, -z),
    ];
    for point in [
        v(1.0, 0.3, -1.5),
        v(1.0, 1.1, -1.5),
        v(1.0 - 1e-3, 0.3, -1.5),
    ] {
        let mut before = (0.0, 0.0);
        for bounces in 2..=4 {
            let (mut flux, mut variance) = (0.0, 0.0);
            for &(corner, right, down) in &walls {
                let mut s = scene(room(low, high, &grey(1.0)), 8, &[]);
                s.laser.beams.push(beam_to(point, v(0.0, 0.0, 1.0), 1));
                s.camera = framed(Vec3::ZERO, corner, right, down, (8, 8));
                let gate = Gate {
                    start_m: 0.0,
                    bin_width_m: 200.0,
                    bins: 1,
                };
                let set = Settings {
                    gate,
                    max_bounces: Some(bounces),
                    seed: u64::from(bounces),
                    ..settings(Budget::Samples(96))
                };
                let r = ok(&s, &set);
                let area = f64::from(right.length()) * f64::from(down.length());
                let got = PI * energy(&r.transient) / 64.0 * area;
                flux += got;
                variance += (got * f64::from(r.error.total_relative)).powi(2);
            }
            let (own, se) = (flux - before.0, variance.sqrt().hypot(before.1));
            near(&format!("{point:?}, bounce {bounces}"), own, 1.0, 0.003, se);
            assert!(se < 0.02, "{se}");
            before = (flux, variance.sqrt());
        }
    }
}

#[test]
fn spots_in_wedges_and_at_the_foot_of_things_agree_with_an_independent_tracer() {
    // A wall that leans over the far one at an angle, through the line x = 1.
    for degrees in [20.0f32, 60.0] {
        let (sin, cos) = degrees.to_radians().sin_cos();
        for d in [0.0f64, 1e-3] {
            let mut things = grey_room();
            things.push(quad(
                v(1.0, -1.0, -4.0),
                v(0.0, 2.0, 0.0),
                v(-cos, 0.0, sin),
                grey(0.6),
            ));
            let mut s = scene(things, 32, &[]);
            let p = v((1.0 - d) as f32, 0.2, -4.0);
            let mut beam = beam_to(p, v(0.0, 0.0, 1.0), 1);
            // The beam arrives along the middle of the wedge.
            let (sin, cos) = (degrees / 2.0).to_radians().sin_cos();
            beam.spot.as_mut().unwrap().arriving = v(cos, 0.0, -sin);
            s.laser.beams.push(beam);
            let start = Start {
                p: P(1.0 - d.max(1e-8), f64::from(0.2f32), -4.0),
                n: P(0.0, 0.0, 1.0),
                object: 1,
            };
            agrees(&format!("wedge of {degrees}°, {d} m"), &s, start, 2 * PATHS);
        }
    }
    // A box on the floor; the floor continues beneath it.
    let mut things = grey_room();
    things.extend(room(v(-0.4, -1.5, -2.9), v(0.3, -0.8, -2.3), &grey(0.5)));
    for d in [0.0f64, 1e-4] {
        let mut s = scene(things.clone(), 32, &[]);
        let p = v(0.1, -1.5, (-2.3 + d) as f32);
        s.laser.beams.push(beam_to(p, v(0.0, 1.0, 0.0), 0));
        let start = Start {
            p: P(f64::from(0.1f32), -1.5, f64::from(-2.3f32) + d.max(1e-8)),
            n: P(0.0, 1.0, 0.0),
            object: 0,
        };
        agrees(&format!("{d} m from the foot of a box"), &s, start, PATHS);
    }
}

#[test]
fn spots_on_rims_are_left_alone() {
    // The rim of a sheet, and the upper edge of a box: no other surface is near, and half of the
    // light misses them.
    let mut things = grey_room();
    things.push(quad(
        v(-0.5, -0.5, -2.5),
        v(1.0, 0.0, 0.0),
        v(0.0, 1.0, 0.0),
        grey(0.7),
    ));
    let mut s = scene(things.clone(), 32, &[]);
    s.laser
        .beams
        .push(beam_to(v(0.5, 0.1, -2.5), v(0.0, 0.0, 1.0), 6));
    let start = Start {
        p: P(0.5, f64::from(0.1f32), -2.5),
        n: P(0.0, 0.0, 1.0),
        object: 6,
    };
    agrees("rim of a sheet", &s, start, PATHS);
}

#[test]
fn light_beside_a_spot_that_goes_by_near_mirrors_is_counted_once() {
    // Conductors of the largest roughness that counts as a mirror, seen by the camera and the
    // corner.
    let mirror = Material {
        bsdf: Bsdf::RoughConductor {
            alpha: 0.1,
            distribution: Distribution::Beckmann,
            reflectance: 0.9,
        },
        ..grey(0.9)
    };
    let pane = |corner, a, b| quad(corner, a, b, mirror.clone());
    let mut things = grey_room();
    things.push(pane(
        v(-1.9, -1.0, -3.9),
        v(1.2, 0.0, -0.05),
        v(0.0, 2.0, 0.0),
    ));
    things.push(pane(v(1.0, -1.4, -3.0), v(0.0, 0.0, 1.0), v(0.9, 0.0, 0.0)));
    let (s, start) = beside_wall(things, 1e-3);
    agrees("a corner seen in mirrors", &s, start, 6 * PATHS);
}

#[test]
fn an_edge_of_black_walls_and_a_facet_alone_are_dark() {
    // A black neighbour absorbs half of the light of a spot on the edge.
    let mut things = grey_room();
    things[3] = object_like(&things[3], black());
    things[5] = object_like(&things[5], black());
    let (s, start) = beside_wall(things, 0.0);
    let start = Start {
        p: P(2.0 - 1e-8, start.p.1, start.p.2),
        ..start
    };
    agrees("black neighbours", &s, start, PATHS);
}

fn object_like(o: &Object, m: Material) -> Object {
    object(
        "wall",
        o.mesh.positions.clone(),
        o.mesh.triangles.clone(),
        m,
    )
}

#[test]
fn parts_and_threads_give_the_same_bits_with_a_spot_on_an_edge() {
    let (s, _) = beside_wall(grey_room(), 0.0);
    let set = settings(Budget::Samples(4));
    let whole = ok(&s, &set);
    let parts: Vec<Part> = PartOf::all(3)
        .map(|which| render_part(&s, &set, which, &Quiet).unwrap())
        .collect();
    let joined = join_parts(&s, &set, parts, &Quiet).unwrap();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(7).build();
    let many = pool.unwrap().install(|| ok(&s, &set));
    for other in [joined, many] {
        assert_eq!(whole.transient, other.transient);
        assert_eq!(whole.error, other.error);
        let (a, b) = (whole.split.as_ref().unwrap(), other.split.unwrap());
        assert_eq!((&a.two, &a.two_se), (&b.two, &b.two_se));
        assert_eq!((&a.multi, &a.multi_noise), (&b.multi, &b.multi_noise));
    }
}
