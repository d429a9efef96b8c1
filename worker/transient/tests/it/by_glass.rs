//! Light that glass reflects and refracts, tested against closed forms and invariants;
//! `independent_glass.rs` tests it against an independent tracer.

use crate::common;

use common::{energy, grey, ok, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Bsdf, Material, Object, Scene};
use picofarm_transient::{Budget, Gate, Rendered, Settings, trace_spots};

fn solid(ior: f32, transmittance: f32) -> Material {
    Material {
        bsdf: Bsdf::Dielectric { ior, transmittance },
        ..Material::solid_glass("solid glass")
    }
}

fn parts(r: &Rendered) -> [f64; 2] {
    let split = r.split.as_ref().expect("a split was asked for");
    [energy(&split.two), energy(&split.multi)]
}

/// Returns means and standard errors of both parts over seeds.
fn over_seeds(scene: &Scene, seeds: u64, samples: u32) -> [(f64, f64); 2] {
    let all: Vec<[f64; 2]> = (0..seeds)
        .map(|seed| {
            let set = Settings {
                seed,
                ..settings(Budget::Samples(samples))
            };
            parts(&ok(scene, &set))
        })
        .collect();
    [0, 1].map(|k| {
        let n = seeds as f64;
        let mean = all.iter().map(|p| p[k]).sum::<f64>() / n;
        let square = all.iter().map(|p| (p[k] - mean).powi(2)).sum::<f64>();
        (mean, (square / (n * (n - 1.0))).sqrt())
    })
}

#[test]
fn bodies_without_a_step_of_the_index_change_no_energy() {
    let objects = |more: Vec<Object>| {
        let mut all = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
        all.extend(more);
        all
    };
    let beams = [v(-2.0, 0.4, -2.5), v(0.3, 1.5, -1.5)];
    let ball = sphere(v(0.8, -0.5, -2.4), 0.6, 3, solid(1.0, 1.0));
    let without = over_seeds(&scene(objects(vec![]), 16, &beams), 16, 16);
    let with = over_seeds(&scene(objects(vec![ball]), 16, &beams), 16, 16);
    for (part, (a, b)) in ["two", "more"]
        .into_iter()
        .zip(without.into_iter().zip(with))
    {
        let (off, se) = (b.0 / a.0 - 1.0, a.1.hypot(b.1) / a.0);
        println!("{part}: {:+.3} % ± {:.3} %", 100.0 * off, 100.0 * se);
        assert!(off.abs() < 1e-3 + 4.0 * se, "{part}: {off} ± {se}");
    }
}

/// Returns the fraction of unpolarised light that a pane of index 1.5 reflects.
fn pane(cos: f64) -> f64 {
    let inside = (1.0 - (1.0 - cos * cos) / 2.25).sqrt();
    let s = ((cos - 1.5 * inside) / (cos + 1.5 * inside)).powi(2);
    let p = ((1.5 * cos - inside) / (1.5 * cos + inside)).powi(2);
    s / (1.0 + s) + p / (1.0 + p)
}

#[test]
fn a_wall_is_lit_by_its_spots_mirror_image_in_a_window() {
    // The wall is in front of the camera and the window behind it, so light reaches the wall from
    // the spot only via the window.
    let wall = quad(
        v(-6.0, -6.0, -3.0),
        v(12.0, 0.0, 0.0),
        v(0.0, 12.0, 0.0),
        grey(0.5),
    );
    let window = quad(
        v(-3.0, -2.0, 1.0),
        v(0.0, 4.0, 0.0),
        v(6.0, 0.0, 0.0),
        Material::glass("window"),
    );
    let spot = [0.6, 0.2, -3.0];
    let s = scene(vec![wall, window], 16, &[v(0.6, 0.2, -3.0)]);
    let set = Settings {
        max_bounces: Some(3),
        ..settings(Budget::Samples(256))
    };
    let got = parts(&ok(&s, &set));
    assert_eq!(got[0], 0.0, "two bounces");
    // Computed from the mirror image, over the middles of 4x4 parts of each pixel.
    let (mut sum, side) = (0.0, 64);
    let i = &s.camera.intrinsics;
    for row in 0..side {
        for col in 0..side {
            let at = |k: usize, c: f32, f: f32| {
                3.0 * ((k as f64 + 0.5) * 16.0 / side as f64 - f64::from(c)) / f64::from(f)
            };
            let (x, y) = (at(col, i.cx, i.fx), -at(row, i.cy, i.fy));
            let (dx, dy, dz) = (x - spot[0], y - spot[1], 8.0);
            let d2: f64 = dx * dx + dy * dy + dz * dz;
            let cos = dz / d2.sqrt();
            // The midpoint of the path is its intersection with the window.
            let (wx, wy) = (spot[0] + dx / 2.0, spot[1] + dy / 2.0);
            if wx.abs() < 3.0 && wy.abs() < 2.0 {
                let albedo = 0.5 / std::f64::consts::PI;
                sum += albedo * albedo * cos * cos / d2 * pane(cos) * 256.0 / (side * side) as f64;
            }
        }
    }
    let off = got[1] / sum - 1.0;
    println!("{:+.3} %", 100.0 * off);
    assert!(off.abs() < 0.02, "{off}");
}

#[test]
fn a_spot_seen_in_a_window_is_as_bright_as_its_mirror_image() {
    // The spot is behind the camera, and the window in front of it.
    let wall = quad(
        v(-6.0, -6.0, 1.0),
        v(12.0, 0.0, 0.0),
        v(0.0, 12.0, 0.0),
        grey(0.5),
    );
    let window = quad(
        v(-3.0, -3.0, -2.0),
        v(0.0, 6.0, 0.0),
        v(6.0, 0.0, 0.0),
        Material::glass("window"),
    );
    let s = scene(vec![wall, window], 16, &[v(0.3, -0.2, 1.0)]);
    let set = settings(Budget::Samples(4096));
    let got = parts(&ok(&s, &set));
    // The spot's image is at (0.3, -0.2, -5).
    let (d2, z) = (0.3f64 * 0.3 + 0.2 * 0.2 + 25.0, 5.0);
    let cos = z / d2.sqrt();
    let i = &s.camera.intrinsics;
    let intensity = 0.5 / std::f64::consts::PI * cos;
    let expected = intensity * pane(cos) * f64::from(i.fx * i.fy) / (d2 * cos.powi(3));
    let off = got[0] / expected - 1.0;
    println!("{:+.3} %", 100.0 * off);
    assert!(off.abs() < 0.03, "{off}");
}

#[test]
fn a_spot_seen_in_a_window_is_as_bright_at_any_resolution_beside_the_windows_edge() {
    // The spot's image appears in the window at (0.12, -0.08).
    let image = |edge: f32, size: u32| {
        let wall = quad(
            v(-6.0, -6.0, 1.0),
            v(12.0, 0.0, 0.0),
            v(0.0, 12.0, 0.0),
            grey(0.5),
        );
        let window = quad(
            v(-3.0, -3.0, -2.0),
            v(0.0, 6.0, 0.0),
            v(3.0 + edge, 0.0, 0.0),
            Material::glass("window"),
        );
        let s = scene(vec![wall, window], size, &[v(0.3, -0.2, 1.0)]);
        let r = ok(&s, &settings(Budget::Samples(2)));
        parts(&r)[0] / f64::from(size * size)
    };
    let (d2, z) = (0.3f64 * 0.3 + 0.2 * 0.2 + 25.0, 5.0);
    let cos = z / d2.sqrt();
    // The film is 2 wide at unit distance.
    let expected = 0.5 / std::f64::consts::PI * cos * pane(cos) / (4.0 * d2 * cos.powi(3));
    for size in [3, 24, 64, 161] {
        let off = image(0.121, size) / expected - 1.0;
        println!("{size}: {:+.3} %", 100.0 * off);
        assert!(off.abs() < 1e-3, "{size}: {off}");
        assert_eq!(image(0.119, size), 0.0, "{size}, beyond the edge");
    }
}

#[test]
fn light_takes_its_time_through_a_body_and_loses_what_fresnel_says() {
    let scene = |ior| {
        let mut objects = room(v(-2.0, -2.0, -4.0), v(2.0, 2.0, 2.0), &grey(0.5));
        // In front of the camera, which looks straight through the middle of the body.
        objects.extend(body(
            v(-0.3, -0.3, -1.5),
            v(0.3, 0.3, -1.0),
            &solid(ior, 1.0),
        ));
        scene(objects, 33, &[v(-2.0, 0.2, -2.0)])
    };
    let set = Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 0.01,
            bins: 2000,
        },
        ..settings(Budget::Samples(128))
    };
    // Returns the energy and the mean path length of the middle pixels.
    let middle = |ior| {
        let r = ok(&scene(ior), &set);
        let two = &r.split.as_ref().unwrap().two;
        let pixels = (14..19).flat_map(|row| (14..19).map(move |col| row * 33 + col));
        let (mut all, mut paths) = (0.0, 0.0);
        for pixel in pixels {
            let h = &two[pixel * 2000..(pixel + 1) * 2000];
            all += energy(h);
            let each = h.iter().enumerate();
            paths += each
                .map(|(k, x)| 0.01 * k as f64 * f64::from(*x))
                .sum::<f64>();
        }
        (all, paths / all)
    };
    let ((air, short), (glass, long)) = (middle(1.0), middle(1.5));
    // 0.96² of the light on the straight path, and 0.5 m of glass instead of air: at most 8 degrees
    // from the normal.
    assert!(
        (glass / air / (0.96 * 0.96) - 1.0).abs() < 0.02,
        "{}",
        glass / air
    );
    assert!((long - short - 0.25).abs() < 0.01, "{}", long - short);
}

#[test]
fn beams_are_refracted_by_bodies_and_split_by_panes() {
    // A prism's faces are not parallel, so the beam leaves in another direction. A slab's faces are
    // parallel, so the beam continues in its direction with an offset.
    let mut objects = room(v(-2.0, -2.0, -4.0), v(2.0, 2.0, 2.0), &grey(0.5));
    let direction = v(0.6, 0.0, -0.8);
    objects.extend(body(
        v(-1.0, -1.0, -1.5),
        v(1.5, 1.0, -1.0),
        &solid(1.5, 1.0),
    ));
    let s = scene(objects, 8, &[direction]);
    let spot = trace_spots(&s).unwrap()[0].expect("the beam ends");
    // Snell: within the glass the sine is 0.4.
    let aside = 0.4 / (1.0f32 - 0.16).sqrt();
    let x = 0.75 * 2.0 + 0.5 * aside - 2.0;
    assert!(spot.point.x.abs() <= 2.0);
    let (to_wall, within) = (2.0 - 0.75 - 0.5 * aside, 0.5 / (1.0f32 - 0.16).sqrt());
    assert!((spot.point.x - 2.0).abs() < 1e-4, "{:?} {x}", spot.point);
    let z = -1.5 - to_wall / 0.75;
    assert!((spot.point.z - z).abs() < 1e-3, "{:?} {z}", spot.point);
    let path = 1.0 / 0.8 + 1.5 * within + to_wall / 0.6;
    assert!((spot.path_m - path).abs() < 1e-3, "{} {path}", spot.path_m);
    assert!((spot.arriving - direction).length() < 1e-5);
}

/// Returns a closed box with facets that face outwards.
fn body(low: picofarm_scene::Vec3, high: picofarm_scene::Vec3, m: &Material) -> Vec<Object> {
    let corner = |k: usize| {
        let of = |bit: usize, a: f32, b: f32| if k >> bit & 1 == 0 { a } else { b };
        v(
            of(0, low.x, high.x),
            of(1, low.y, high.y),
            of(2, low.z, high.z),
        )
    };
    let sides = [
        [0, 4, 6, 2],
        [1, 3, 7, 5],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 2, 3, 1],
        [4, 5, 7, 6],
    ];
    let triangles = sides
        .iter()
        .flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    vec![common::object(
        "body",
        (0..8).map(corner).collect(),
        triangles.collect(),
        m.clone(),
    )]
}
