//! Furniture to sit and lie on: sofas, armchairs, chairs, stools and beds.

use crate::{Affine, Mesh, Vec3, rng::Rng, shape::Shape};

use super::materials::{board, cloth, linen, plastic, wood};

/// Turns about x by `angle` (positive leans the top back, towards −z), then moves.
fn leaning(angle: f32, at: Vec3) -> Affine {
    let (s, c) = (libm::sinf(angle), libm::cosf(angle));
    Affine {
        linear: [
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(0.0, c, s),
            Vec3::new(0.0, -s, c),
        ],
        translation: at,
    }
}

/// Adds four legs of side `t` under the rectangle ±x, ±z, up to `height`.
pub(super) fn legs(
    shape: &mut Shape,
    [x, z]: [f32; 2],
    height: f32,
    t: f32,
    round: bool,
    material: u32,
) {
    for (sx, sz) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let (cx, cz) = (sx * (x - t * 0.5), sz * (z - t * 0.5));
        if round {
            shape.cylinder([cx, cz], [0.0, height], [t * 0.35, t * 0.5], 12, material);
        } else {
            let h = t * 0.5;
            shape.cuboid([cx - h, 0.0, cz - h], [cx + h, height, cz + h], material);
        }
    }
}

/// Builds a seat with arms, cushions and a leaning back; `seats` cushions wide.
fn upholstered(rng: &mut Rng, name: &str, seats: u32, seat_width: f32) -> Mesh {
    let mut shape = Shape::new(name);
    let cover = shape.material(cloth(rng));
    let cushion = shape.material(cloth(rng));
    let foot = shape.material(wood(rng));
    let arm = rng.range(0.1, 0.22);
    let depth = rng.range(0.78, 0.95);
    let (seat, back, arm_top) = (
        rng.range(0.38, 0.45),
        rng.range(0.72, 0.9),
        rng.range(0.54, 0.66),
    );
    let inner = seats as f32 * seat_width * 0.5;
    let (x, z) = (inner + arm, depth * 0.5);
    let lift = rng.range(0.06, 0.14);
    legs(
        &mut shape,
        [x - 0.02, z - 0.02],
        lift,
        0.06,
        rng.chance(0.5),
        foot,
    );
    shape.cuboid([-x, lift, -z], [x, seat - 0.14, z], cover);
    for side in [-1.0, 1.0f32] {
        let (a, b) = (side * inner, side * x);
        shape.cuboid([a.min(b), seat - 0.14, -z], [a.max(b), arm_top, z], cover);
    }
    shape.cuboid(
        [-inner, seat - 0.14, -z],
        [inner, back - 0.06, -z + 0.16],
        cover,
    );
    for k in 0..seats {
        let x0 = -inner + k as f32 * seat_width + 0.008;
        let x1 = x0 + seat_width - 0.016;
        shape.cuboid([x0, seat - 0.14, -z + 0.16], [x1, seat, z + 0.02], cushion);
        shape.placed(leaning(0.2, Vec3::new(0.0, seat, -z + 0.26)), |s| {
            s.cuboid([x0, 0.0, -0.08], [x1, back - seat, 0.08], cushion);
        });
    }
    shape.finish()
}

pub(super) fn sofa(rng: &mut Rng) -> Mesh {
    let seats = 2 + rng.below(2) as u32;
    let width = rng.range(0.6, 0.72);
    upholstered(rng, "sofa", seats, width)
}

pub(super) fn armchair(rng: &mut Rng) -> Mesh {
    let width = rng.range(0.52, 0.62);
    upholstered(rng, "armchair", 1, width)
}

pub(super) fn stool(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("stool");
    let (leg, seat) = (shape.material(wood(rng)), shape.material(cloth(rng)));
    let (radius, height) = (rng.range(0.16, 0.21), rng.range(0.42, 0.65));
    if rng.chance(0.3) {
        // A pouffe.
        let bulge = [
            [0.0, 0.0],
            [radius, 0.01],
            [radius * 1.2, height * 0.4],
            [radius, height * 0.75],
            [0.0, height * 0.8],
        ];
        shape.lathe([0.0; 2], &bulge, 24, seat);
    } else {
        legs(
            &mut shape,
            [radius * 0.75, radius * 0.75],
            height - 0.05,
            0.035,
            true,
            leg,
        );
        shape.cylinder(
            [0.0; 2],
            [height - 0.05, height],
            [radius, radius * 0.95],
            24,
            seat,
        );
    }
    shape.finish()
}

pub(super) fn chair(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("chair");
    let frame = shape.material(board(rng));
    let seat_material = shape.material(if rng.chance(0.5) {
        cloth(rng)
    } else {
        board(rng)
    });
    let (x, z) = (rng.range(0.2, 0.24), rng.range(0.2, 0.24));
    let (seat, back, t) = (
        rng.range(0.43, 0.48),
        rng.range(0.82, 1.0),
        rng.range(0.03, 0.045),
    );
    if rng.chance(0.2) {
        // An office chair: a star foot, a column, a padded seat.
        let dark = shape.material(plastic(rng));
        for k in 0..5 {
            let turn = Affine::yaw_then_move(k as f32 * 1.256_637, Vec3::ZERO);
            shape.placed(turn, |s| {
                s.cuboid([-0.025, 0.04, 0.0], [0.025, 0.08, 0.29], dark)
            });
        }
        shape.cylinder([0.0; 2], [0.0, seat - 0.07], [0.03, 0.03], 16, dark);
    } else {
        legs(&mut shape, [x, z], seat - 0.03, t, rng.chance(0.4), frame);
    }
    shape.cuboid([-x, seat - 0.03, -z], [x, seat, z], seat_material);
    let slats = 1 + rng.below(3);
    shape.placed(leaning(0.12, Vec3::new(0.0, seat, -z + t)), |s| {
        let h = back - seat;
        for side in [-1.0, 1.0] {
            let c = side * (x - t * 0.5);
            s.cuboid(
                [c - t * 0.5, 0.0, -t * 0.5],
                [c + t * 0.5, h, t * 0.5],
                frame,
            );
        }
        for k in 0..slats {
            let top = h * (1.0 - k as f32 * 0.28);
            let height = if slats == 1 { h * 0.6 } else { h * 0.16 };
            s.cuboid(
                [-x + t, top - height, -0.012],
                [x - t, top, 0.012],
                seat_material,
            );
        }
    });
    shape.finish()
}

pub(super) fn bed(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("bed");
    let frame = shape.material(board(rng));
    let sheet = shape.material(linen(rng));
    let cover = shape.material(cloth(rng));
    let x = *rng.pick(&[0.45, 0.6, 0.7, 0.8]);
    let z = rng.range(0.98, 1.05);
    let (rail, mattress) = (rng.range(0.26, 0.34), rng.range(0.44, 0.54));
    legs(&mut shape, [x, z], rail - 0.12, 0.07, false, frame);
    shape.cuboid([-x, rail - 0.12, -z], [x, rail, z], frame);
    shape.cuboid([-x, 0.0, -z - 0.05], [x, rng.range(0.8, 1.1), -z], frame);
    shape.cuboid(
        [-x + 0.02, rail, -z + 0.01],
        [x - 0.02, mattress, z - 0.02],
        sheet,
    );
    let turn = rng.range(-0.45, -0.2);
    shape.cuboid(
        [-x + 0.005, mattress - 0.15, turn],
        [x - 0.005, mattress + 0.05, z - 0.005],
        cover,
    );
    let pillows = if x > 0.55 { 2 } else { 1 };
    for k in 0..pillows {
        let cx = if pillows == 1 {
            0.0
        } else {
            (k as f32 - 0.5) * x
        };
        let centre = Vec3::new(cx, mattress + 0.05, -z + 0.28);
        shape.placed(
            pillow(centre, [x / pillows as f32 * 0.8, 0.075, 0.2]),
            |s| {
                s.ellipsoid(Vec3::ZERO, [1.0, 1.0], 10, sheet);
            },
        );
    }
    shape.finish()
}

/// Returns the map of the unit ball to a pillow of these half extents.
fn pillow(at: Vec3, [x, y, z]: [f32; 3]) -> Affine {
    Affine {
        linear: [
            Vec3::new(x, 0.0, 0.0),
            Vec3::new(0.0, y, 0.0),
            Vec3::new(0.0, 0.0, z),
        ],
        translation: at,
    }
}
