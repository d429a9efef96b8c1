//! Furniture with boards, drawers and doors: tables, shelves and cases.

use crate::{Mesh, rng::Rng, shape::Shape};

use super::{
    materials::{board, bright, ceramic, paint, plastic, wood},
    upholstery::legs,
};

/// Builds a table of the given half extents: a rectangular or round top on legs.
fn top_on_legs(rng: &mut Rng, name: &str, [x, z]: [f32; 2], height: f32, round: bool) -> Mesh {
    let mut shape = Shape::new(name);
    let top = shape.material(board(rng));
    let leg = shape.material(board(rng));
    let t = rng.range(0.022, 0.045);
    if round {
        shape.cylinder([0.0; 2], [height - t, height], [x, x], 40, top);
        if rng.chance(0.5) {
            let foot = [
                [0.0, 0.0],
                [x * 0.55, 0.0],
                [x * 0.5, 0.03],
                [0.05, 0.06],
                [0.04, height - t],
                [0.0, height - t],
            ];
            shape.lathe([0.0; 2], &foot, 24, leg);
        } else {
            legs(
                &mut shape,
                [x * 0.68, x * 0.68],
                height - t,
                0.055,
                true,
                leg,
            );
        }
    } else {
        shape.cuboid([-x, height - t, -z], [x, height, z], top);
        let (thick, round_legs) = (rng.range(0.04, 0.08), rng.chance(0.35));
        legs(
            &mut shape,
            [x - 0.02, z - 0.02],
            height - t,
            thick,
            round_legs,
            leg,
        );
        if rng.chance(0.6) {
            let (a, b) = (x - 0.02 - thick, z - 0.02 - thick);
            for side in [-1.0, 1.0] {
                let (cz, cx) = (side * (b + thick * 0.5), side * (a + thick * 0.5));
                shape.cuboid(
                    [-a, height - t - 0.08, cz - 0.01],
                    [a, height - t, cz + 0.01],
                    leg,
                );
                shape.cuboid(
                    [cx - 0.01, height - t - 0.08, -b],
                    [cx + 0.01, height - t, b],
                    leg,
                );
            }
        }
    }
    shape.finish()
}

pub(super) fn coffee_table(rng: &mut Rng) -> Mesh {
    let (x, z) = (rng.range(0.35, 0.55), rng.range(0.25, 0.35));
    let (height, round) = (rng.range(0.36, 0.48), rng.chance(0.35));
    top_on_legs(rng, "coffee_table", [x, z], height, round)
}

pub(super) fn table(rng: &mut Rng) -> Mesh {
    let (x, z) = (rng.range(0.45, 0.8), rng.range(0.35, 0.45));
    let (height, round) = (rng.range(0.71, 0.77), rng.chance(0.3));
    top_on_legs(
        rng,
        "table",
        [if round { z.max(0.42) } else { x }, z],
        height,
        round,
    )
}

pub(super) fn desk(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("desk");
    let top = shape.material(board(rng));
    let body = shape.material(board(rng));
    let knob = shape.material(plastic(rng));
    let (x, z, h) = (
        rng.range(0.5, 0.75),
        rng.range(0.28, 0.38),
        rng.range(0.71, 0.76),
    );
    shape.cuboid([-x, h - 0.03, -z], [x, h, z], top);
    let side = if rng.chance(0.5) { 1.0 } else { -1.0 };
    let (a, b) = (side * (x - 0.4), side * (x - 0.01));
    case(
        &mut shape,
        [a.min(b), 0.0, -z + 0.02],
        [a.max(b), h - 0.03, z - 0.03],
        body,
        knob,
        3,
    );
    let (a, b) = (-side * (x - 0.01), -side * (x - 0.04));
    shape.cuboid(
        [a.min(b), 0.0, -z + 0.02],
        [a.max(b), h - 0.03, z - 0.03],
        body,
    );
    shape.cuboid(
        [-x + 0.05, h - 0.35, -z + 0.03],
        [x - 0.05, h - 0.03, -z + 0.05],
        body,
    );
    shape.finish()
}

/// Adds a closed case with `fronts` drawers on its front (+z), one above the other, with knobs.
fn case(shape: &mut Shape, lo: [f32; 3], hi: [f32; 3], body: u32, knob: u32, fronts: u32) {
    shape.cuboid(lo, [hi[0], hi[1], hi[2] - 0.018], body);
    let step = (hi[1] - lo[1] - 0.04) / fronts as f32;
    for k in 0..fronts {
        let y = lo[1] + 0.03 + k as f32 * step;
        shape.cuboid(
            [lo[0] + 0.008, y, hi[2] - 0.017],
            [hi[0] - 0.008, y + step - 0.01, hi[2]],
            body,
        );
        let (cx, cy) = ((lo[0] + hi[0]) * 0.5, y + step * 0.5);
        shape.cuboid(
            [cx - 0.05, cy - 0.008, hi[2]],
            [cx + 0.05, cy + 0.008, hi[2] + 0.018],
            knob,
        );
    }
}

/// Adds a case with `count` doors in a row, from `lo` to `hi`.
fn doors(shape: &mut Shape, lo: [f32; 3], hi: [f32; 3], [body, front, knob]: [u32; 3], count: u32) {
    shape.cuboid(lo, [hi[0], hi[1], hi[2] - 0.02], body);
    let step = (hi[0] - lo[0]) / count as f32;
    for k in 0..count {
        let x = lo[0] + k as f32 * step;
        shape.cuboid(
            [x + 0.004, lo[1] + 0.06, hi[2] - 0.019],
            [x + step - 0.004, hi[1] - 0.01, hi[2]],
            front,
        );
        let at = if k % 2 == 0 {
            x + step - 0.05
        } else {
            x + 0.05
        };
        let y = (lo[1] + hi[1]) * 0.5;
        shape.cuboid(
            [at - 0.008, y - 0.07, hi[2]],
            [at + 0.008, y + 0.07, hi[2] + 0.022],
            knob,
        );
    }
}

fn drawers(rng: &mut Rng, name: &str, [x, z]: [f32; 2], height: f32, fronts: u32) -> Mesh {
    let mut shape = Shape::new(name);
    let body = shape.material(board(rng));
    let knob = shape.material(plastic(rng));
    let lift = if rng.chance(0.5) { 0.1 } else { 0.0 };
    if lift > 0.0 {
        legs(&mut shape, [x - 0.01, z - 0.02], lift, 0.04, true, body);
    }
    case(
        &mut shape,
        [-x, lift, -z],
        [x, height - 0.02, z],
        body,
        knob,
        fronts,
    );
    shape.cuboid(
        [-x - 0.01, height - 0.02, -z],
        [x + 0.01, height, z + 0.01],
        body,
    );
    shape.finish()
}

pub(super) fn nightstand(rng: &mut Rng) -> Mesh {
    let half = [rng.range(0.19, 0.26), rng.range(0.17, 0.21)];
    let (height, fronts) = (rng.range(0.45, 0.58), 1 + rng.below(2) as u32);
    drawers(rng, "nightstand", half, height, fronts)
}

pub(super) fn dresser(rng: &mut Rng) -> Mesh {
    let half = [rng.range(0.38, 0.6), rng.range(0.2, 0.25)];
    let (height, fronts) = (rng.range(0.75, 1.1), 3 + rng.below(2) as u32);
    drawers(rng, "dresser", half, height, fronts)
}

pub(super) fn tv_stand(rng: &mut Rng) -> Mesh {
    let half = [rng.range(0.55, 0.8), rng.range(0.18, 0.23)];
    let height = rng.range(0.4, 0.55);
    drawers(rng, "tv_stand", half, height, 1)
}

pub(super) fn cabinet(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("cabinet");
    let materials = [
        shape.material(board(rng)),
        shape.material(board(rng)),
        shape.material(plastic(rng)),
    ];
    let count = 1 + rng.below(3) as u32;
    let (x, z, h) = (
        count as f32 * rng.range(0.2, 0.26),
        rng.range(0.22, 0.3),
        rng.range(0.78, 0.95),
    );
    doors(
        &mut shape,
        [-x, 0.0, -z],
        [x, h - 0.03, z],
        materials,
        count,
    );
    shape.cuboid([-x, h - 0.03, -z], [x, h, z + 0.015], materials[0]);
    shape.finish()
}

pub(super) fn wardrobe(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("wardrobe");
    let materials = [
        shape.material(board(rng)),
        shape.material(board(rng)),
        shape.material(plastic(rng)),
    ];
    let count = 2 + rng.below(2) as u32;
    let (x, z, h) = (
        count as f32 * rng.range(0.23, 0.28),
        rng.range(0.27, 0.31),
        rng.range(1.85, 2.15),
    );
    doors(&mut shape, [-x, 0.0, -z], [x, h, z], materials, count);
    shape.finish()
}

/// Builds an open case of boards with `rows` compartments, filled with books and other objects.
fn open_case(rng: &mut Rng, name: &str, [x, z]: [f32; 2], height: f32, rows: u32) -> Mesh {
    let mut shape = Shape::new(name);
    let wood = shape.material(board(rng));
    let covers: Vec<u32> = (0..5).map(|_| shape.material(bright(rng))).collect();
    let t = 0.02;
    for side in [-1.0, 1.0f32] {
        let (a, b) = (side * x, side * (x - t));
        shape.cuboid([a.min(b), 0.0, -z], [a.max(b), height, z], wood);
    }
    shape.cuboid([-x + t, 0.0, -z], [x - t, height, -z + 0.008], wood);
    let step = (height - t) / rows as f32;
    for k in 0..=rows {
        let y = k as f32 * step;
        shape.cuboid([-x + t, y, -z + 0.008], [x - t, y + t, z], wood);
        if k == rows {
            break;
        }
        let mut at = -x + t + 0.005;
        let end = (x - t) * rng.range(0.2, 0.95);
        let mut index = rng.below(covers.len());
        while at < end {
            let w = rng.range(0.015, 0.05);
            let (h, d) = (step * rng.range(0.5, 0.85), z * rng.range(1.0, 1.5));
            if at + w > x - t {
                break;
            }
            shape.cuboid(
                [at, y + t, -z + 0.01],
                [at + w - 0.001, y + t + h, -z + 0.01 + d],
                covers[index],
            );
            at += w;
            index = (index + 1 + rng.below(covers.len() - 1)) % covers.len();
        }
    }
    shape.finish()
}

pub(super) fn bookcase(rng: &mut Rng) -> Mesh {
    let (half, rows) = (
        [rng.range(0.3, 0.55), rng.range(0.13, 0.17)],
        4 + rng.below(3) as u32,
    );
    let height = rows as f32 * rng.range(0.32, 0.36);
    open_case(rng, "bookcase", half, height, rows)
}

pub(super) fn shelf(rng: &mut Rng) -> Mesh {
    let (half, rows) = (
        [rng.range(0.25, 0.5), rng.range(0.14, 0.18)],
        2 + rng.below(2) as u32,
    );
    let height = rows as f32 * rng.range(0.32, 0.42);
    open_case(rng, "shelf", half, height, rows)
}

pub(super) fn kitchen_appliance(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("kitchen_appliance");
    let body = shape.material(paint(rng));
    let dark = shape.material(plastic(rng));
    let z = rng.range(0.28, 0.31);
    if rng.chance(0.5) {
        let (x, h) = (rng.range(0.28, 0.32), rng.range(1.5, 1.8));
        shape.cuboid([-x, 0.04, -z], [x, h, z - 0.05], body);
        for (a, b) in [(0.06, h * 0.36), (h * 0.37, h)] {
            shape.cuboid([-x, a, z - 0.045], [x, b - 0.005, z], body);
            shape.cuboid(
                [x - 0.06, (a + b) * 0.5 - 0.15, z],
                [x - 0.04, (a + b) * 0.5 + 0.15, z + 0.03],
                dark,
            );
        }
    } else {
        let (x, h) = (0.3, rng.range(0.85, 0.9));
        shape.cuboid([-x, 0.0, -z], [x, h, z - 0.02], body);
        shape.cuboid([-x + 0.03, 0.15, z - 0.02], [x - 0.03, 0.62, z], dark);
        shape.cuboid(
            [-x + 0.05, 0.64, z - 0.02],
            [x - 0.05, 0.66, z + 0.03],
            body,
        );
        for k in 0..4 {
            let (cx, cz) = ((k % 2) as f32 * 0.28 - 0.14, (k / 2) as f32 * 0.24 - 0.13);
            shape.cylinder([cx, cz], [h, h + 0.008], [0.09, 0.09], 20, dark);
        }
    }
    shape.finish()
}

pub(super) fn sink(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("sink");
    let materials = [
        shape.material(board(rng)),
        shape.material(board(rng)),
        shape.material(plastic(rng)),
    ];
    let basin = shape.material(ceramic(rng));
    let (x, z, h) = (
        rng.range(0.3, 0.5),
        rng.range(0.27, 0.31),
        rng.range(0.82, 0.9),
    );
    doors(&mut shape, [-x, 0.0, -z], [x, h, z], materials, 2);
    let r = 0.17;
    let bowl = [
        [0.0, h + 0.001],
        [r * 0.6, h + 0.001],
        [r, h + 0.12],
        [r + 0.015, h + 0.12],
        [r * 0.7, h],
    ];
    shape.lathe([0.0, 0.04], &bowl, 28, basin);
    shape.cylinder(
        [0.0, -z + 0.06],
        [h, h + 0.26],
        [0.015, 0.015],
        12,
        materials[2],
    );
    shape.cuboid(
        [-0.012, h + 0.24, -z + 0.06],
        [0.012, h + 0.262, 0.0],
        materials[2],
    );
    shape.finish()
}

pub(super) fn piano(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("piano");
    let body = shape.material(if rng.chance(0.5) {
        wood(rng)
    } else {
        plastic(rng)
    });
    let white = shape.material(ceramic(rng));
    let x = rng.range(0.7, 0.75);
    shape.cuboid([-x, 0.0, -0.28], [x, 1.15, 0.02], body);
    shape.cuboid([-x, 0.6, 0.02], [x, 0.7, 0.28], body);
    for side in [-1.0, 1.0f32] {
        let (a, b) = (side * x, side * (x - 0.06));
        shape.cuboid([a.min(b), 0.0, 0.2], [a.max(b), 0.6, 0.26], body);
    }
    shape.cuboid([-x + 0.07, 0.7, 0.06], [x - 0.07, 0.715, 0.27], white);
    shape.finish()
}

pub(super) fn radiator(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("radiator");
    let white = shape.material(paint(rng));
    let columns = 8 + rng.below(8);
    let (h, pitch) = (rng.range(0.5, 0.65), 0.06);
    let x = columns as f32 * pitch * 0.5;
    for k in 0..columns {
        let a = -x + k as f32 * pitch;
        shape.cuboid([a, 0.1, -0.045], [a + 0.042, 0.1 + h, 0.045], white);
    }
    for y in [0.14, 0.06 + h] {
        shape.cuboid([-x, y, -0.012], [x - 0.02, y + 0.024, 0.012], white);
    }
    for cx in [-x + 0.1, x - 0.1] {
        shape.cuboid([cx - 0.01, 0.0, -0.01], [cx + 0.01, 0.14, 0.01], white);
    }
    shape.finish()
}

pub(super) fn fireplace(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("fireplace");
    let stone = shape.material(ceramic(rng));
    let soot = shape.material(plastic(rng));
    let (x, z, h) = (
        rng.range(0.5, 0.65),
        rng.range(0.17, 0.22),
        rng.range(0.95, 1.1),
    );
    let gap = x * 0.6;
    for side in [-1.0, 1.0f32] {
        let (a, b) = (side * x, side * gap);
        shape.cuboid([a.min(b), 0.0, -z], [a.max(b), h - 0.08, z], stone);
    }
    shape.cuboid([-gap, h * 0.65, -z], [gap, h - 0.08, z], stone);
    shape.cuboid([-gap, 0.0, -z], [gap, h * 0.65, -z + 0.03], soot);
    shape.cuboid([-x - 0.05, h - 0.08, -z], [x + 0.05, h, z + 0.05], stone);
    shape.finish()
}
