//! Energy: closed white rooms, bright corners, sums of very many terms, light on the edges of bins,
//! textures.

use crate::common;

use std::f64::consts::PI;

use common::{
    beam_to, energy, framed, grey, multi_energy, near, ok, quad, room, scene, settings, sphere, v,
};
use picofarm_scene::{Aim, Camera, Material, Scene, Texture, Vec3, Wrap};
use picofarm_transient::{Budget, Gate, Settings};

fn long(bins: u32) -> Gate {
    Gate {
        start_m: 0.0,
        bin_width_m: 200.0 / f64::from(bins),
        bins,
    }
}

/// A wall in view: the camera that frames it, and its area.
struct View(Camera, f64);

fn view(origin: Vec3, corner: Vec3, right: Vec3, down: Vec3) -> View {
    let area = f64::from(right.length()) * f64::from(down.length());
    View(framed(origin, corner, right, down, (8, 8)), area)
}

/// Returns the cumulative flux that leaves the walls in view after 2..=`longest` bounces, each with
/// its standard error, per unit of emitted light: π times mean radiance times area.
fn fluxes(s: &Scene, views: &[View], longest: u32, passes: u32) -> Vec<(f64, f64)> {
    let mut all = vec![];
    for bounces in 2..=longest {
        let (mut sum, mut variance) = (0.0, 0.0);
        for View(camera, area) in views {
            let s = Scene {
                camera: *camera,
                ..s.clone()
            };
            let set = Settings {
                gate: long(1),
                max_bounces: Some(bounces),
                seed: u64::from(bounces),
                ..settings(Budget::Samples(passes))
            };
            let r = ok(&s, &set);
            let flux = PI * energy(&r.transient) / 64.0 * area;
            sum += flux;
            variance += (flux * f64::from(r.error.total_relative)).powi(2);
        }
        all.push((sum, variance.sqrt()));
    }
    all
}

/// Returns each bounce's own flux from the cumulative ones.
fn each(all: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let before = std::iter::once(&(0.0, 0.0)).chain(all);
    all.iter()
        .zip(before)
        .map(|(b, a)| (b.0 - a.0, b.1.hypot(a.1)))
        .collect()
}

#[test]
fn a_closed_white_room_keeps_all_energy_at_every_bounce() {
    let (low, high) = (v(-1.2, -0.9, -1.5), v(1.0, 1.1, 0.8));
    let size = high - low;
    let (x, y, z) = (
        v(size.x, 0.0, 0.0),
        v(0.0, size.y, 0.0),
        v(0.0, 0.0, size.z),
    );
    let o = Vec3::ZERO;
    let views = [
        view(o, v(low.x, high.y, low.z), x, -y),
        view(o, v(high.x, high.y, high.z), -x, -y),
        view(o, v(high.x, high.y, low.z), z, -y),
        view(o, v(low.x, high.y, high.z), -z, -y),
        view(o, v(low.x, low.y, low.z), x, z),
        view(o, v(low.x, high.y, high.z), x, -z),
    ];
    // The second spot is 3 cm from an edge, to test corners as well.
    for (point, longest, most) in [(v(0.4, 0.3, -1.5), 5, 0.01), (v(0.97, 0.3, -1.5), 4, 0.06)] {
        let mut s = scene(room(low, high, &grey(1.0)), 8, &[]);
        s.laser.beams.push(beam_to(point, v(0.0, 0.0, 1.0), 1));
        for (k, (flux, se)) in each(&fluxes(&s, &views, longest, 128)).iter().enumerate() {
            near(&format!("bounce {}", k + 2), *flux, 1.0, 0.003, *se);
            assert!(*se < most, "{se}");
        }
    }
}

#[test]
fn a_bright_corner_loses_at_least_its_absorption_at_every_bounce() {
    // Two walls at a right angle with albedo 0.95, and a spot 10 cm from the edge.
    let albedo = 0.95f32;
    let front = quad(
        v(-1.0, -1.0, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(albedo),
    );
    let side = quad(
        v(1.0, -1.0, -2.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, 2.0),
        grey(albedo),
    );
    let mut s = scene(vec![front, side], 8, &[]);
    s.laser
        .beams
        .push(beam_to(v(0.9, 0.1, -2.0), v(0.0, 0.0, 1.0), 0));
    let down = v(0.0, -2.0, 0.0);
    let views = [
        view(Vec3::ZERO, v(-1.0, 1.0, -2.0), v(2.0, 0.0, 0.0), down),
        view(Vec3::ZERO, v(1.0, 1.0, -2.0), v(0.0, 0.0, 2.0), down),
    ];
    let each = each(&fluxes(&s, &views, 5, 256));
    let mut before = (f64::from(albedo), 0.0);
    for (k, &(flux, se)) in each.iter().enumerate() {
        let most = f64::from(albedo) * before.0;
        let se = se.hypot(before.1);
        println!("bounce {}: {flux:.5} ± {se:.5}, at most {most:.5}", k + 2);
        assert!(flux > 0.0 && flux <= most + 3.0 * se);
        before = (flux, se);
    }
    // Two bounces have a closed form: the light that reaches the side wall, by quadrature.
    let (n, mut form) = (1000, 0.0);
    for i in 0..n * n {
        let at = |i: usize| 2.0 * (i as f64 + 0.5) / n as f64;
        let (b, c) = (at(i % n) - 1.0 - f64::from(0.1f32), at(i / n));
        let l = 1.0 - f64::from(0.9f32);
        let d2 = l * l + b * b + c * c;
        form += c * l / (PI * d2 * d2) * 4.0 / (n * n) as f64;
    }
    near(
        "two",
        each[0].0,
        form * f64::from(albedo).powi(2),
        0.003,
        0.0,
    );
}

/// Returns a white sphere, in which every path from spot to pixel counts the same: bounce k adds
/// 1/(4π²R²).
fn bright_sphere(spots: u32) -> Scene {
    let mut s = scene(vec![sphere(Vec3::ZERO, 2.0, 5, grey(1.0))], 2, &[]);
    s.laser = Aim::grid(spots).unwrap().laser(&s.camera);
    s
}

/// Renders a sum of `passes` passes into a single bin. Returns it relative to the exact one, and
/// its standard error.
fn many_terms(spots: u32, passes: u32) -> (f64, f64) {
    let set = Settings {
        gate: long(1),
        max_bounces: Some(4),
        ..settings(Budget::Samples(passes))
    };
    let r = ok(&bright_sphere(spots), &set);
    let (got, se) = multi_energy(&r);
    let exact = 4.0 * 2.0 * f64::from(spots) / (4.0 * PI * PI * 4.0);
    println!("{} rays", r.rays);
    (got / exact, se / exact)
}

/// About 5·10⁶ terms per pixel, or 10⁸ with PICOFARM_LONG_TESTS set.
#[test]
fn sums_of_very_many_small_terms_lose_nothing_in_f32() {
    let times = if std::env::var_os("PICOFARM_LONG_TESTS").is_some() {
        20
    } else {
        1
    };
    for (spots, passes) in [(100, 8_000), (1, 40_000)] {
        let (few, _) = many_terms(spots, passes / 30);
        let (many, se) = many_terms(spots, passes * times);
        println!("{spots} spots: few {few:.5}, many {many:.5} ± {se:.5}");
        // The faceted sphere is a little smaller than the round one.
        assert!((many - 1.0).abs() < 0.01 + 4.0 * se);
        assert!((many / few - 1.0).abs() < 0.01);
    }
}

#[test]
fn a_one_bounce_peak_of_4e7_leaves_every_other_bin_its_bits() {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    // A pixel of 10⁻⁸ sr makes the peak as high as the reference's highest.
    let mut s = scene(walls, 4, &[v(0.0005, 0.0003, -1.0)]);
    (s.camera.intrinsics.fx, s.camera.intrinsics.fy) = (3e4, 3e4);
    (s.camera.intrinsics.cx, s.camera.intrinsics.cy) = (-13.5, 10.5);
    let run = |one_bounce| {
        let set = Settings {
            one_bounce,
            ..settings(Budget::Samples(64))
        };
        ok(&s, &set).transient
    };
    let (with, without) = (run(true), run(false));
    let mut peaks = vec![];
    for (k, (a, b)) in with.iter().zip(&without).enumerate() {
        if a != b {
            peaks.push((k, *a, *b));
        }
    }
    println!("{peaks:?}");
    assert_eq!(peaks.len(), 1);
    let pixel = &without[peaks[0].0 / 637 * 637..][..637];
    assert!(peaks[0].1 > 1e6, "{}", peaks[0].1);
    assert!(energy(pixel) > 0.0);
}

#[test]
fn a_peak_exactly_on_a_bins_edge_belongs_to_the_later_bin() {
    // Lengths that f32 represents exactly: 4 m of path, bins of 1/4 m.
    let wall = || {
        quad(
            v(-3.0, -3.0, -2.0),
            v(6.0, 0.0, 0.0),
            v(0.0, 6.0, 0.0),
            grey(0.5),
        )
    };
    let mut s = scene(vec![wall()], 3, &[v(0.0, 0.0, -1.0)]);
    s.camera.intrinsics.cx = 1.5;
    let bin_of = |start_m: f64, bin_width_m: f64, bins: u32| {
        let set = Settings {
            gate: Gate {
                start_m,
                bin_width_m,
                bins,
            },
            max_bounces: Some(1),
            one_bounce: true,
            ..settings(Budget::Samples(1))
        };
        let r = ok(&s, &set);
        (
            r.transient
                .iter()
                .position(|&h| h > 0.0)
                .map(|k| k % bins as usize),
            r.overflow.energy,
        )
    };
    assert_eq!(bin_of(3.0, 0.25, 8).0, Some(4));
    assert_eq!(bin_of(4.0, 0.25, 8).0, Some(0));
    // The gate is half open: its end is outside.
    let (bin, lost) = bin_of(2.0, 0.25, 8);
    assert!(bin.is_none() && lost > 0.0);
    let (bin, lost) = bin_of(2.0, 0.25, 9);
    assert!(bin == Some(8) && lost == 0.0);
}

#[test]
fn a_shift_by_whole_bins_shifts_every_bin_and_no_bit_of_two_bounces() {
    let front = quad(
        v(-1.0, -1.0, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(0.7),
    );
    let side = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -2.9),
        grey(0.7),
    );
    let mut s = scene(vec![front, side], 8, &[]);
    s.laser
        .beams
        .push(beam_to(v(-1.5, 0.25, -0.5), v(1.0, 0.0, 0.0), 1));
    s.laser.beams[0].spot.as_mut().unwrap().path_m = 1.5;
    let set = |start_m| Settings {
        gate: Gate {
            start_m,
            bin_width_m: 1.0 / 32.0,
            bins: 512,
        },
        ..settings(Budget::Samples(64))
    };
    let plain = ok(&s, &set(1.0)).split.unwrap();
    let earlier = ok(&s, &set(0.5)).split.unwrap();
    s.laser.beams[0].spot.as_mut().unwrap().path_m = 3.5;
    let later = ok(&s, &set(1.0)).split.unwrap();
    let (mut moved, mut all) = (0.0, 0.0);
    for k in 0..64 {
        for b in 0..400 {
            let at = k * 512 + b;
            assert_eq!(plain.two[at], earlier.two[at + 16]);
            assert_eq!(plain.two[at], later.two[at + 64]);
            moved += f64::from((plain.multi[at] - later.multi[at + 64]).abs());
            all += f64::from(plain.multi[at]);
        }
    }
    // Shared arrivals are computed in f32 bins, so few change their bin.
    println!("multi moved {:e}", moved / all);
    assert!(moved < 1e-3 * all);
}

/// Returns a material with a checkerboard of 2×2 texels per unit of texture space.
fn checkered(mut m: Material, bright: u8, dark: u8) -> Material {
    let texels = vec![[bright; 3], [dark; 3], [dark; 3], [bright; 3]];
    m.texture = Some(
        Texture::new("checkers", 2, 2, texels, Wrap::Repeat)
            .unwrap()
            .into(),
    );
    m
}

#[test]
fn a_checkerboard_gives_two_and_three_bounces_its_mean_albedo() {
    let plain = |m: Material, times: f32| {
        let mut screen = quad(
            v(-1.0, -1.0, -2.0),
            v(2.0, 0.0, 0.0),
            v(0.0, 2.0, 0.0),
            m.clone(),
        );
        let mut mesh = (*screen.mesh).clone();
        mesh.uv = vec![[0.0, 0.0], [times, 0.0], [times, times], [0.0, times]];
        screen.mesh = mesh.into();
        let mut floor = quad(v(-1.0, -1.0, -2.0), v(0.0, 0.0, 3.0), v(2.0, 0.0, 0.0), m);
        floor.mesh = picofarm_scene::Mesh {
            uv: screen.mesh.uv.clone(),
            ..(*floor.mesh).clone()
        }
        .into();
        let side = quad(
            v(-1.5, -1.0, 1.0),
            v(0.0, 2.0, 0.0),
            v(0.0, 0.0, -2.9),
            grey(0.7),
        );
        let mut s = scene(vec![screen, side, floor], 16, &[]);
        s.laser
            .beams
            .push(beam_to(v(-1.5, 0.2, -0.5), v(1.0, 0.0, 0.0), 1));
        let (corner, right, down) = (v(-1.0, 1.0, -2.0), v(2.0, 0.0, 0.0), v(0.0, -2.0, 0.0));
        s.camera = framed(Vec3::ZERO, corner, right, down, (16, 16));
        let set = Settings {
            max_bounces: Some(3),
            ..settings(Budget::Samples(256))
        };
        let r = ok(&s, &set);
        (energy(&r.split.as_ref().unwrap().two), multi_energy(&r))
    };
    // sRGB bytes 188 and 99 are 0.5029 and 0.1248 in linear light.
    let m = checkered(grey(0.8), 188, 99);
    let mean = f64::from(m.texture.as_ref().unwrap().mean()[0]);
    assert!((mean - 0.31385).abs() < 1e-4, "{mean}");
    let (two, (multi, se)) = plain(m, 29.0);
    let (base, (base_multi, base_se)) = plain(grey(0.8), 29.0);
    near("two", two, base * mean, 0.003, 0.0);
    let scale = mean * mean;
    near(
        "three",
        multi,
        base_multi * scale,
        0.003,
        se.hypot(base_se * scale),
    );
    // A spot on a texel of value 0.5029.
    let spot_on = |m: Material| {
        let mut wall = quad(v(-1.5, -1.0, 1.0), v(0.0, 2.0, 0.0), v(0.0, 0.0, -3.0), m);
        let mut mesh = (*wall.mesh).clone();
        mesh.uv = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        wall.mesh = mesh.into();
        let screen = quad(
            v(-1.0, -1.0, -2.0),
            v(2.0, 0.0, 0.0),
            v(0.0, 2.0, 0.0),
            grey(0.7),
        );
        let mut s = scene(vec![wall, screen], 8, &[]);
        s.laser
            .beams
            .push(beam_to(v(-1.5, -0.5, 0.25), v(1.0, 0.0, 0.0), 0));
        let two = Settings {
            max_bounces: Some(2),
            ..settings(Budget::Samples(1))
        };
        energy(&ok(&s, &two).transient)
    };
    let (on, bare) = (spot_on(checkered(grey(0.8), 188, 99)), spot_on(grey(0.8)));
    near("spot", on / bare, 0.50289, 1e-3, 0.0);
}
