//! Screens, speakers, clocks and other devices.

use crate::{Affine, Mesh, Vec3, rng::Rng, shape::Shape};

use super::materials::{board, bright, linen, plastic};

pub(super) fn tv(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("tv");
    let m = shape.material(plastic(rng));
    let (x, h) = (rng.range(0.38, 0.55), rng.range(0.45, 0.62));
    shape.cuboid([-x * 0.4, 0.0, -0.1], [x * 0.4, 0.012, 0.1], m);
    shape.cuboid([-0.04, 0.012, -0.03], [0.04, 0.08, -0.01], m);
    shape.cuboid([-x, 0.07, -0.025], [x, 0.07 + h, 0.02], m);
    shape.finish()
}

pub(super) fn computer(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("computer");
    let m = shape.material(plastic(rng));
    let (x, h) = (rng.range(0.24, 0.3), rng.range(0.3, 0.36));
    shape.cuboid([-0.11, 0.0, -0.09], [0.11, 0.012, 0.09], m);
    shape.cuboid([-0.025, 0.012, -0.04], [0.025, 0.16, -0.02], m);
    shape.cuboid([-x, 0.1, -0.02], [x, 0.1 + h, 0.015], m);
    shape.finish()
}

pub(super) fn laptop(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("laptop");
    let m = shape.material(plastic(rng));
    let (x, d) = (rng.range(0.15, 0.19), rng.range(0.21, 0.25));
    shape.cuboid([-x, 0.0, -d * 0.5], [x, 0.014, d * 0.5], m);
    let angle = rng.range(0.15, 0.5);
    let (s, c) = (libm::sinf(angle), libm::cosf(angle));
    let lid = Affine {
        linear: [
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(0.0, c, s),
            Vec3::new(0.0, -s, c),
        ],
        translation: Vec3::new(0.0, 0.016, -d * 0.5),
    };
    shape.placed(lid, |p| p.cuboid([-x, 0.0, -0.003], [x, d, 0.003], m));
    shape.finish()
}

pub(super) fn keyboard(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("keyboard");
    let (body, keys) = (shape.material(plastic(rng)), shape.material(plastic(rng)));
    let x = rng.range(0.15, 0.22);
    shape.cuboid([-x, 0.0, -0.07], [x, 0.016, 0.07], body);
    for row in 0..4 {
        let z = -0.055 + row as f32 * 0.028;
        shape.cuboid([-x + 0.01, 0.016, z], [x - 0.01, 0.022, z + 0.022], keys);
    }
    shape.finish()
}

pub(super) fn phone(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("phone");
    let m = shape.material(plastic(rng));
    shape.cuboid([-0.036, 0.0, -0.075], [0.036, 0.009, 0.075], m);
    shape.finish()
}

pub(super) fn speaker(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("speaker");
    let (body, cone) = (shape.material(board(rng)), shape.material(plastic(rng)));
    let (x, z, h) = (
        rng.range(0.07, 0.13),
        rng.range(0.08, 0.14),
        rng.range(0.22, 0.5),
    );
    shape.cuboid([-x, 0.0, -z], [x, h, z], body);
    for (y, r) in [(h * 0.35, x * 0.75), (h * 0.78, x * 0.4)] {
        // A shallow disc standing on the front.
        let upright = Affine {
            linear: [
                Vec3::new(1.0, 0.0, 0.0),
                Vec3::new(0.0, 0.0, -1.0),
                Vec3::new(0.0, 1.0, 0.0),
            ],
            translation: Vec3::new(0.0, y, z),
        };
        shape.placed(upright, |s| {
            s.cylinder([0.0; 2], [0.0, 0.012], [r, r * 0.8], 24, cone)
        });
    }
    shape.finish()
}

pub(super) fn clock(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("clock");
    let (body, face) = (shape.material(bright(rng)), shape.material(linen(rng)));
    let (x, h) = (rng.range(0.05, 0.08), rng.range(0.08, 0.13));
    shape.cuboid([-x, 0.0, -0.03], [x, h, 0.03], body);
    shape.cuboid([-x + 0.01, 0.01, 0.03], [x - 0.01, h - 0.01, 0.033], face);
    shape.finish()
}

pub(super) fn kettle(rng: &mut Rng) -> Mesh {
    let mut shape = Shape::new("small_appliance");
    let (body, grip) = (shape.material(bright(rng)), shape.material(plastic(rng)));
    let (r, h) = (rng.range(0.065, 0.085), rng.range(0.17, 0.23));
    let profile = [
        [0.0, 0.0],
        [r, 0.0],
        [r * 1.02, h * 0.3],
        [r * 0.7, h * 0.9],
        [r * 0.25, h],
        [0.0, h * 1.05],
    ];
    shape.lathe([0.0; 2], &profile, 24, body);
    shape.cuboid(
        [-r - 0.05, h * 0.25, -0.012],
        [-r - 0.03, h * 0.9, 0.012],
        grip,
    );
    for y in [0.25, 0.82] {
        shape.cuboid(
            [-r - 0.03, h * y, -0.012],
            [-r * 0.6, h * (y + 0.08), 0.012],
            grip,
        );
    }
    shape.finish()
}
