//! Long thin triangles: light is the same for a surface of needles and one of many short triangles.
//! Rays that start or end on a needle must not hit it, and must not miss objects next to it.

use crate::common;

use common::{energy, grey, near, object, ok, room, scene, settings, two_only, v};
use picofarm_scene::{Material, Mesh, Object, Scene, Vec3};
use picofarm_transient::{Budget, Rendered, Settings};

/// Longest side of a triangle that is not cut at any width: the tip of a spike stays a needle at
/// any size.
const SHORT: f32 = 0.005;

/// Returns the object with every triangle halved along its longest side until none is longer than
/// four times its width.
fn cut(o: &Object) -> Object {
    let mesh = &o.mesh;
    let mut all = Mesh {
        positions: vec![],
        triangles: vec![],
        triangle_material: vec![],
        ..(**mesh).clone()
    };
    let corner = |i: u32| mesh.positions[i as usize];
    for (t, &m) in mesh.triangles.iter().zip(&mesh.triangle_material) {
        let mut open = vec![t.map(corner)];
        while let Some(t) = open.pop() {
            let side = |k: usize| (t[(k + 1) % 3] - t[k]).length();
            let k = (1..3).fold(0, |a, b| if side(b) > side(a) { b } else { a });
            let [a, b, c] = [t[k], t[(k + 1) % 3], t[(k + 2) % 3]];
            let wide = side(k) * side(k) <= 4.0 * (b - a).cross(c - a).length();
            if wide || side(k) < SHORT {
                let first = all.positions.len() as u32;
                all.positions.extend(t);
                all.triangles.push([first, first + 1, first + 2]);
                all.triangle_material.push(m);
                continue;
            }
            let middle = (a + b) * 0.5;
            open.extend([[a, middle, c], [middle, b, c]]);
        }
    }
    Object {
        mesh: all.into(),
        ..o.clone()
    }
}

/// Returns a rectangle around `middle`.
fn strip(middle: Vec3, along: Vec3, across: Vec3, (length, width): (f32, f32)) -> Object {
    let l = along.normalized();
    let n = l.cross(across).normalized();
    let (l, w) = (l * (0.5 * length), n.cross(l) * (0.5 * width));
    let positions = vec![
        middle - l - w,
        middle + l - w,
        middle + l + w,
        middle - l + w,
    ];
    object("strip", positions, vec![[0, 1, 2], [0, 2, 3]], grey(0.7))
}

/// Returns triangles around an axis from `foot` to `top`: a rod if both ends have a radius, a spike
/// if the top has none.
fn rod(foot: Vec3, top: Vec3, (below, above): (f32, f32), sides: u32) -> Object {
    let axis = (top - foot).normalized();
    let u = axis.cross(v(0.3, 0.9, 0.1)).normalized();
    let w = axis.cross(u);
    let mut positions = vec![];
    for k in 0..sides {
        let angle = std::f32::consts::TAU * k as f32 / sides as f32;
        let out = u * angle.cos() + w * angle.sin();
        positions.extend([foot + out * below, top + out * above]);
    }
    let triangles = (0..sides).flat_map(|k| {
        let (i, j) = (2 * k, 2 * ((k + 1) % sides));
        [[i, j, j + 1], [i, j + 1, i + 1]]
    });
    let mut triangles: Vec<[u32; 3]> = triangles.collect();
    if above == 0.0 {
        triangles.retain(|t| t.iter().filter(|&&i| i % 2 == 1).count() < 2);
    }
    object("rod", positions, triangles, grey(0.7))
}

fn walls() -> Vec<Object> {
    room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6))
}

/// Returns the two-bounce renders of a room with an object that a beam ends on: once with the
/// object whole, and once with it cut.
fn whole_and_cut(thing: Object, target: Vec3) -> [Rendered; 2] {
    let render = |thing: Object| {
        let mut objects = walls();
        objects.push(thing);
        ok(&scene(objects, 16, &[target]), &two_only())
    };
    [render(thing.clone()), render(cut(&thing))]
}

/// Fails unless both renders have the same light, in total and by pixel, because their camera paths
/// are the same. The corners of short triangles are rounded to f32, which tilts those of a narrow
/// strip. Only this difference remains between the two.
#[track_caller]
fn same(what: &str, [whole, cut]: &[Rendered; 2]) {
    let place = |r: &Rendered| r.spots[0].expect("the beam ends on the thing");
    let apart = (place(whole).point - place(cut).point).length();
    assert!(apart < 1e-5, "{what}: spots {apart} m apart");
    assert_eq!(place(whole).object, 6, "{what}: the spot is on the thing");
    let pixels = |r: &Rendered| -> Vec<f64> { r.transient.chunks(637).map(energy).collect() };
    let (a, b) = (pixels(whole), pixels(cut));
    let all = b.iter().sum::<f64>();
    assert!(all > 0.0, "{what}: no light");
    near(what, a.iter().sum(), all, 1e-2, 0.0);
    let off: f64 = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum();
    assert!(
        off < 3e-2 * all,
        "{what}: pixels are {:.2} % off",
        100.0 * off / all
    );
}

#[test]
fn a_spot_on_a_strip_lights_as_much_as_on_the_strip_cut_into_short_triangles() {
    let middle = v(0.1, -0.2, -2.6);
    let ways = [
        (v(1.0, 0.0, 0.0), v(0.0, 1.0, 0.0)),
        (v(0.8, 0.35, 0.3), v(0.0, 0.9, 0.2)),
        (v(0.7, -0.3, -0.4), v(0.2, 0.8, 0.3)),
        (v(0.2, 1.0, 0.25), v(1.0, 0.1, 0.2)),
        (v(0.15, 0.3, 1.0), v(0.9, -0.5, 0.0)),
    ];
    for (k, (along, across)) in ways.into_iter().enumerate() {
        let length = if k == 3 { 2.2 } else { 2.6 };
        for (n, width) in [0.001, 0.003, 0.03].into_iter().enumerate() {
            // Targets close to the diagonal, on either side of it, and away from the middle.
            let l = along.normalized();
            let w = l.cross(across).normalized().cross(l);
            let at = [0.31, -0.22, 0.02, -0.4][(k + n) % 4] * length;
            let target = middle + l * at + w * (0.2 * width);
            let thing = strip(middle, along, across, (length, width));
            same(
                &format!("way {k}, {width} m"),
                &whole_and_cut(thing, target),
            );
        }
    }
}

#[test]
fn a_spot_on_a_rod_or_a_spike_lights_as_much_as_on_one_cut_into_short_triangles() {
    let (foot, top) = (v(-0.6, -1.1, -2.2), v(0.5, 1.0, -2.9));
    for (radii, sides) in [
        ((0.003, 0.003), 8),
        ((0.001, 0.001), 3),
        ((0.02, 0.02), 64),
        ((0.004, 0.0), 5),
    ] {
        for share in [0.3, 0.52, 0.8] {
            let target = foot + (top - foot) * share;
            let thing = rod(foot, top, radii, sides);
            same(
                &format!("{radii:?}, {share}"),
                &whole_and_cut(thing, target),
            );
        }
    }
}

/// Returns a parallelogram of `count` strips that share their vertices.
fn of_strips(corner: Vec3, a: Vec3, b: Vec3, count: u32, m: Material) -> Object {
    let mut positions = vec![];
    for k in 0..=count {
        let at = corner + b * (k as f32 / count as f32);
        positions.extend([at, at + a]);
    }
    let triangles = (0..count).flat_map(|k| {
        let i = 2 * k;
        [[i, i + 1, i + 3], [i, i + 3, i + 2]]
    });
    object("strips", positions, triangles.collect(), m)
}

/// Returns the energies of two bounces, and of three and more with their standard error.
fn parts(s: &Scene, samples: u32) -> (f64, f64, f64) {
    let set = Settings {
        seed: 3,
        ..settings(Budget::Samples(samples))
    };
    let r = ok(s, &set);
    let split = r.split.as_ref().expect("a split was asked for");
    let se = f64::from(r.error.total_relative) * energy(&r.transient);
    (energy(&split.two), energy(&split.multi), se)
}

#[test]
fn walls_and_panes_of_needles_are_as_bright_as_whole_ones() {
    let spots = [v(0.2, -1.5, -2.0), v(-2.0, 0.3, -2.2), v(0.6, 0.5, -4.0)];
    let with = |count: u32, glass: bool| {
        let mut objects = walls();
        // A tilted floor, and a pane in front of the back wall.
        let (a, b) = (v(3.6, 0.1, -0.2), v(0.15, -0.05, 3.2));
        objects.push(of_strips(v(-1.9, -1.4, -3.7), a, b, count, grey(0.5)));
        if glass {
            let (a, b) = (v(2.6, 0.2, 0.1), v(-0.1, 1.6, 0.1));
            let pane = Material::glass("pane");
            objects.push(of_strips(v(-1.2, -0.8, -3.6), a, b, count, pane));
        }
        scene(objects, 16, &spots)
    };
    for glass in [false, true] {
        let samples = if glass { 64 } else { 16 };
        let (one, many) = (
            parts(&with(1, glass), samples),
            parts(&with(2400, glass), samples),
        );
        let two = if glass { 0.02 } else { 1e-3 };
        near(
            &format!("two bounces, glass {glass}"),
            many.0,
            one.0,
            two,
            0.0,
        );
        near(
            &format!("three and more, glass {glass}"),
            many.1,
            one.1,
            2e-3,
            one.2.hypot(many.2),
        );
    }
}
