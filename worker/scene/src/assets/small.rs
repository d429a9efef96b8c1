//! Small objects for tops and floors, and lamps, plants and rugs.

use std::f32::consts::TAU;

use crate::{Affine, Mesh, Vec3, rng::Rng, shape::Shape};

use super::materials::{board, bright, ceramic, cloth, leaf, linen, plastic, wood};

pub(super) fn table_lamp(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("lamp");
    let (foot, shade) = (shape.material(ceramic(rng)), shape.material(linen(rng)));
    let (r, h) = (rng.range(0.05, 0.08), rng.range(0.16, 0.28));
    let body = [
        [0.0, 0.0],
        [r, 0.0],
        [r, 0.012],
        [r * 0.4, 0.03],
        [r * 0.9, h * 0.5],
        [0.012, h],
        [0.0, h],
    ];
    shape.lathe([0.0; 2], &body, 20, foot);
    shade_at(rng, &mut shape, h, r * 2.0, shade);
    shape.finish()
}

pub(super) fn floor_lamp(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("lamp");
    let (foot, shade) = (shape.material(plastic(rng)), shape.material(linen(rng)));
    let h = rng.range(1.2, 1.45);
    let pole = [
        [0.0, 0.0],
        [0.14, 0.0],
        [0.13, 0.02],
        [0.013, 0.03],
        [0.013, h],
        [0.0, h],
    ];
    shape.lathe([0.0; 2], &pole, 20, foot);
    shade_at(rng, &mut shape, h, 0.19, shade);
    shape.finish()
}

/// Adds a shade with a wall of 3 mm, open above and below, around the top of a stand.
fn shade_at(rng: &mut Rng, shape: &mut Shape, y: f32, radius: f32, material: u32) {
    let (top, height) = (radius * rng.range(0.5, 0.95), radius * rng.range(1.0, 1.4));
    let (y0, y1) = (y - height * 0.25, y + height * 0.75);
    let wall = [
        [radius - 0.003, y0],
        [radius, y0],
        [top, y1],
        [top - 0.003, y1],
        [radius - 0.003, y0],
    ];
    shape.lathe([0.0; 2], &wall, 28, material);
    // The bar that supports the shade.
    shape.cuboid(
        [-top + 0.004, y, -0.003],
        [top - 0.004, y + 0.005, 0.003],
        material,
    );
}

pub(super) fn plant(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("plant");
    let (pot, green, soil) = (
        shape.material(ceramic(rng)),
        shape.material(leaf(rng)),
        shape.material(wood(rng)),
    );
    let big = rng.chance(0.5);
    let (r, h) = if big {
        (rng.range(0.13, 0.18), rng.range(0.22, 0.32))
    } else {
        (rng.range(0.05, 0.08), rng.range(0.08, 0.12))
    };
    let profile = [
        [0.0, 0.0],
        [r * 0.75, 0.0],
        [r, h],
        [r * 0.9, h],
        [r * 0.85, h * 0.85],
        [0.0, h * 0.85],
    ];
    shape.lathe([0.0; 2], &profile, 24, pot);
    shape.cylinder([0.0; 2], [h * 0.85, h * 0.88], [r * 0.8, r * 0.8], 16, soil);
    let (leaves, long) = (
        10 + rng.below(14),
        if big {
            rng.range(0.35, 0.6)
        } else {
            rng.range(0.1, 0.18)
        },
    );
    for _ in 0..leaves {
        let (yaw, tilt) = (rng.range(0.0, TAU), rng.range(0.15, 1.0));
        let length = long * rng.range(0.6, 1.1);
        let frame = leaf_frame(yaw, tilt, Vec3::new(0.0, h * 0.86, 0.0), length);
        shape.placed(frame, |s| blade(s, green));
    }
    shape.finish()
}

/// Adds a leaf of unit length along y, pointed at both ends, as two folded halves with both sides.
fn blade(shape: &mut Shape, material: u32) {
    let spine = [[0.0, 0.02], [0.45, 0.1], [0.8, 0.06], [1.0, 0.0]];
    let width = [0.015, 0.13, 0.09, 0.004];
    for k in 0..3 {
        let at = |i: usize, side: f32| {
            Vec3::new(side * width[i], spine[i][0], spine[i][1] - width[i] * 0.3)
        };
        let mid = |i: usize| Vec3::new(0.0, spine[i][0], spine[i][1]);
        shape.quad([mid(k), at(k, 1.0), at(k + 1, 1.0), mid(k + 1)], material);
        shape.quad([at(k, -1.0), mid(k), mid(k + 1), at(k + 1, -1.0)], material);
    }
}

/// Scales by `length`, tilts away from the vertical, turns about it, and moves.
fn leaf_frame(yaw: f32, tilt: f32, at: Vec3, length: f32) -> Affine {
    let (sy, cy, st, ct) = (
        libm::sinf(yaw),
        libm::cosf(yaw),
        libm::sinf(tilt),
        libm::cosf(tilt),
    );
    let (x, y, z) = (
        Vec3::new(cy, 0.0, -sy),
        Vec3::new(sy * st, ct, cy * st),
        Vec3::new(sy * ct, -st, cy * ct),
    );
    let row = |k: usize| Vec3::new(x[k], y[k], z[k]) * length;
    Affine {
        linear: [row(0), row(1), row(2)],
        translation: at,
    }
}

pub(super) fn vase(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("vase");
    let m = shape.material(ceramic(rng));
    let (r, h) = (rng.range(0.04, 0.09), rng.range(0.14, 0.35));
    let (belly, neck) = (rng.range(1.0, 1.5), rng.range(0.35, 0.8));
    let profile = [
        [0.0, 0.0],
        [r * 0.7, 0.0],
        [r * belly * 0.95, h * 0.25],
        [r * belly, h * 0.4],
        [r * neck, h * 0.8],
        [r * neck * 1.25, h],
        [r * neck * 1.1, h],
        [r * neck * 0.8, h * 0.8],
        [0.0, h * 0.75],
    ];
    shape.lathe([0.0; 2], &profile, 28, m);
    shape.finish()
}

pub(super) fn rug(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("rug");
    let (field, border) = (shape.material(cloth(rng)), shape.material(cloth(rng)));
    if rng.chance(0.3) {
        let r = rng.range(0.6, 0.95);
        shape.cylinder([0.0; 2], [0.0, 0.008], [r, r], 48, field);
    } else {
        let (x, z) = (rng.range(0.7, 1.1), rng.range(0.5, 0.75));
        shape.cuboid([-x, 0.0, -z], [x, 0.006, z], border);
        shape.cuboid(
            [-x + 0.08, 0.006, -z + 0.08],
            [x - 0.08, 0.009, z - 0.08],
            field,
        );
    }
    shape.finish()
}

/// Builds one to four books, lying flat.
pub(super) fn books(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("book");
    let paper = shape.material(linen(rng));
    let mut y = 0.0;
    for _ in 0..1 + rng.below(4) {
        let cover = shape.material(bright(rng));
        let (x, z, t) = (
            rng.range(0.07, 0.11),
            rng.range(0.1, 0.14),
            rng.range(0.015, 0.035),
        );
        let frame = Affine::yaw_then_move(rng.range(-0.3, 0.3), Vec3::new(0.0, y, 0.0));
        shape.placed(frame, |s| {
            s.cuboid([-x, 0.0, -z], [x, 0.002, z], cover);
            s.cuboid(
                [-x + 0.002, 0.002, -z + 0.004],
                [x - 0.004, t - 0.002, z - 0.004],
                paper,
            );
            s.cuboid([-x, t - 0.002, -z], [x, t, z], cover);
            s.cuboid([-x, 0.002, -z], [-x + 0.002, t - 0.002, z], cover);
        });
        y += t;
    }
    shape.finish()
}

pub(super) fn cup(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("cup");
    let m = shape.material(ceramic(rng));
    let (r, h) = (rng.range(0.033, 0.045), rng.range(0.07, 0.11));
    let profile = [
        [0.0, 0.0],
        [r * 0.8, 0.0],
        [r, h],
        [r - 0.004, h],
        [r * 0.8 - 0.004, 0.006],
        [0.0, 0.006],
    ];
    shape.lathe([0.0; 2], &profile, 24, m);
    for (lo, hi) in [(0.25, 0.33), (0.7, 0.78)] {
        shape.cuboid([r * 0.85, h * lo, -0.005], [r + 0.025, h * hi, 0.005], m);
    }
    shape.cuboid(
        [r + 0.018, h * 0.25, -0.005],
        [r + 0.026, h * 0.78, 0.005],
        m,
    );
    shape.finish()
}

pub(super) fn bottle(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("bottle");
    let m = shape.material(bright(rng));
    let (r, h) = (rng.range(0.03, 0.045), rng.range(0.2, 0.32));
    let profile = [
        [0.0, 0.0],
        [r, 0.0],
        [r, h * 0.6],
        [r * 0.4, h * 0.78],
        [r * 0.4, h],
        [0.0, h],
    ];
    shape.lathe([0.0; 2], &profile, 24, m);
    shape.finish()
}

fn bowl_into(shape: &mut Shape, r: f32, h: f32, material: u32) {
    let profile = [
        [0.0, 0.0],
        [r * 0.45, 0.0],
        [r * 0.85, h * 0.5],
        [r, h],
        [r - 0.005, h],
        [r * 0.8, h * 0.5],
        [r * 0.4, 0.01],
        [0.0, 0.01],
    ];
    shape.lathe([0.0; 2], &profile, 28, material);
}

pub(super) fn bowl(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("bowl");
    let m = shape.material(ceramic(rng));
    let (r, h) = (rng.range(0.07, 0.14), rng.range(0.05, 0.08));
    bowl_into(&mut shape, r, h, m);
    shape.finish()
}

pub(super) fn plate(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("plate");
    let m = shape.material(ceramic(rng));
    let (r, h) = (rng.range(0.09, 0.14), rng.range(0.018, 0.025));
    bowl_into(&mut shape, r, h, m);
    shape.finish()
}

/// A bowl with fruit in it.
pub(super) fn fruit(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("food");
    let m = shape.material(ceramic(rng));
    bowl_into(&mut shape, 0.13, 0.06, m);
    for k in 0..4 + rng.below(3) {
        let colour = shape.material(bright(rng));
        let (a, r) = (k as f32 * 1.3, rng.range(0.03, 0.04));
        let ring = if k == 0 { 0.0 } else { 0.068 };
        let centre = Vec3::new(
            ring * libm::cosf(a),
            if k == 0 { 0.085 } else { 0.062 },
            ring * libm::sinf(a),
        );
        shape.ellipsoid(centre, [r, r], 10, colour);
    }
    shape.finish()
}

/// A tower of toy blocks.
pub(super) fn blocks(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("toy");
    let mut y = 0.0;
    for k in 0..2 + rng.below(4) {
        let m = shape.material(bright(rng));
        let half = rng.range(0.025, 0.05);
        let frame = Affine::yaw_then_move(rng.range(0.0, TAU), Vec3::new(0.0, y, 0.0));
        shape.placed(frame, |s| {
            if k % 3 == 2 {
                s.cylinder([0.0; 2], [0.0, half * 2.0], [half, half], 20, m);
            } else {
                s.cuboid([-half, 0.0, -half], [half, half * 2.0, half], m);
            }
        });
        y += half * 2.0;
    }
    shape.finish()
}

/// A sitting bear of balls.
pub(super) fn teddy(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("toy");
    let fur = shape.material(wood(rng));
    let k = rng.range(0.7, 1.4);
    let mut ball = |x: f32, y: f32, z: f32, r: f32, h: f32| {
        shape.ellipsoid(Vec3::new(x, y, z) * k, [r * k, h * k], 12, fur);
    };
    ball(0.0, 0.1, 0.0, 0.085, 0.1);
    ball(0.0, 0.245, 0.01, 0.068, 0.065);
    ball(0.0, 0.235, 0.07, 0.028, 0.024);
    for s in [-1.0, 1.0] {
        ball(s * 0.055, 0.3, 0.0, 0.025, 0.025);
        ball(s * 0.055, 0.035, 0.095, 0.035, 0.035);
        ball(s * 0.095, 0.13, 0.035, 0.03, 0.055);
    }
    shape.finish()
}

pub(super) fn basket(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("basket");
    let m = shape.material(board(rng));
    let (r, h) = (rng.range(0.12, 0.2), rng.range(0.22, 0.4));
    let profile = [
        [0.0, 0.0],
        [r * 0.8, 0.0],
        [r, h],
        [r - 0.008, h],
        [r * 0.8 - 0.008, 0.01],
        [0.0, 0.01],
    ];
    shape.lathe([0.0; 2], &profile, 24, m);
    shape.finish()
}

/// A cardboard box, shut or with its flaps up.
pub(super) fn carton(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("box");
    let m = shape.material(wood(rng));
    let (x, z, h) = (
        rng.range(0.08, 0.24),
        rng.range(0.07, 0.2),
        rng.range(0.1, 0.36),
    );
    if rng.chance(0.5) {
        shape.cuboid([-x, 0.0, -z], [x, h, z], m);
        return shape.finish();
    }
    let t = 0.005;
    shape.cuboid([-x, 0.0, -z], [x, t, z], m);
    for side in [-1.0, 1.0f32] {
        let (a, b) = (side * x, side * (x - t));
        shape.cuboid([a.min(b), t, -z], [a.max(b), h, z], m);
        let (a, b) = (side * z, side * (z - t));
        shape.cuboid([-x + t, t, a.min(b)], [x - t, h * 1.2, a.max(b)], m);
    }
    shape.finish()
}

/// A rucksack.
pub(super) fn bag(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("bag");
    let (body, pocket) = (shape.material(cloth(rng)), shape.material(bright(rng)));
    let k = rng.range(0.85, 1.15);
    let ball = |x: f32, y: f32, z: f32, at: Vec3| Affine {
        linear: [
            Vec3::new(x, 0.0, 0.0),
            Vec3::new(0.0, y, 0.0),
            Vec3::new(0.0, 0.0, z),
        ],
        translation: at,
    };
    shape.placed(
        ball(0.16 * k, 0.23 * k, 0.09 * k, Vec3::new(0.0, 0.23 * k, 0.0)),
        |s| {
            s.ellipsoid(Vec3::ZERO, [1.0, 1.0], 14, body);
        },
    );
    shape.placed(
        ball(
            0.11 * k,
            0.1 * k,
            0.05 * k,
            Vec3::new(0.0, 0.15 * k, 0.08 * k),
        ),
        |s| {
            s.ellipsoid(Vec3::ZERO, [1.0, 1.0], 12, pocket);
        },
    );
    shape.finish()
}

pub(super) fn ball(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("ball");
    let m = shape.material(bright(rng));
    let r = rng.range(0.06, 0.14);
    shape.ellipsoid(Vec3::new(0.0, r, 0.0), [r, r], 16, m);
    shape.finish()
}

/// A pair of weights.
pub(super) fn dumbbell(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("exercise");
    let (iron, grip) = (shape.material(plastic(rng)), shape.material(board(rng)));
    let r = rng.range(0.05, 0.09);
    for z in [-r * 1.3, r * 1.3] {
        let lying = Affine {
            linear: [
                Vec3::new(0.0, 1.0, 0.0),
                Vec3::new(-1.0, 0.0, 0.0),
                Vec3::new(0.0, 0.0, 1.0),
            ],
            translation: Vec3::new(0.0, r, z),
        };
        shape.placed(lying, |s| {
            s.cylinder([0.0; 2], [-0.08, 0.08], [0.015, 0.015], 12, grip);
            s.cylinder([0.0; 2], [-0.15, -0.08], [r, r], 8, iron);
            s.cylinder([0.0; 2], [0.08, 0.15], [r, r], 8, iron);
        });
    }
    shape.finish()
}
