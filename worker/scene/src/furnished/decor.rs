//! Objects on the walls: a door, a window, pictures and mirrors, some of them near-mirrors.

use std::sync::Arc;

use crate::{Material, Mesh, layout::Footprint, rng::Rng, shape::Shape, trace::Model};

use super::plan::{Plan, half_of};

/// The roughness α of the near-mirrors.
const MIRROR_ALPHA: f32 = 0.01;
/// The distance of hung objects from the wall, metres.
const HANG_GAP: f32 = 0.001;
/// The free floor in front of a door, metres.
const DOOR_CLEARANCE: f32 = 0.55;

fn tone(rng: &mut Rng, name: &str, lo: f32, hi: f32) -> Material {
    let level = rng.range(lo, hi);
    let rgb = [(); 3].map(|()| (level * rng.range(0.75, 1.15)).min(0.92));
    Material::diffuse(name, rgb)
}

/// Builds a flat frame of the given width around a thin panel, standing on y = 0.
fn framed(name: &str, [w, h, d]: [f32; 3], border: f32, frame: Material, panel: Material) -> Mesh {
    let mut shape = Shape::new(name);
    let (f, p) = (shape.material(frame), shape.material(panel));
    let (x, z) = (w * 0.5, d * 0.5);
    shape.cuboid([-x, 0.0, -z], [x, border, z], f);
    shape.cuboid([-x, h - border, -z], [x, h, z], f);
    shape.cuboid([-x, border, -z], [-x + border, h - border, z], f);
    shape.cuboid([x - border, border, -z], [x, h - border, z], f);
    shape.cuboid(
        [-x + border, border, -z],
        [x - border, h - border, z * 0.3],
        p,
    );
    shape.finish()
}

/// Hangs a model on a random wall with its bottom at `y`, if there is space.
fn hang(rng: &mut Rng, plan: &mut Plan<'_>, label: &'static str, mesh: Mesh, y: f32) -> bool {
    let model = Arc::new(Model::new(mesh).expect("what hangs on walls has triangles"));
    (0..20).any(|_| {
        let along = rng.range(-1.0, 1.0);
        let (at, yaw) = plan
            .room
            .against_wall(rng.below(4), along, half_of(&model), HANG_GAP);
        plan.try_place((label, &model), label, [at[0], y, at[1]], yaw, None)
    })
}

/// Hangs a closed door with free floor in front of it, and usually a window with an opaque pane,
/// unless the room has an open door or a glazed window.
pub(super) fn doors_and_windows(rng: &mut Rng, plan: &mut Plan<'_>, [open, glazed]: [bool; 2]) {
    if !open {
        door(rng, plan);
    }
    if !glazed && rng.chance(0.75) {
        window(rng, plan);
    }
}

fn door(rng: &mut Rng, plan: &mut Plan<'_>) {
    let size = [rng.range(0.8, 0.95), rng.range(1.98, 2.1), 0.05];
    let mesh = framed(
        "door",
        size,
        0.07,
        tone(rng, "frame", 0.5, 0.8),
        tone(rng, "leaf", 0.35, 0.85),
    );
    if hang(rng, plan, "door", mesh, super::plan::CONTACT_GAP)
        && let Some(door) = plan.placed.last()
    {
        let half = [size[0] * 0.5, DOOR_CLEARANCE * 0.5];
        let (s, c) = (libm::sinf(door.yaw), libm::cosf(door.yaw));
        let off = size[2] * 0.5 + half[1];
        let at = [door.at[0] + s * off, 0.0, door.at[2] + c * off];
        plan.reserved.push(Footprint::new(at, door.yaw, half, 2.0));
    }
}

fn window(rng: &mut Rng, plan: &mut Plan<'_>) {
    let size = [rng.range(0.7, 1.3), rng.range(0.8, 1.2), 0.06];
    let y = rng.range(0.85, 1.05).min(plan.room.height - size[1] - 0.1);
    let mesh = framed(
        "window",
        size,
        0.06,
        tone(rng, "frame", 0.75, 0.9),
        tone(rng, "pane", 0.3, 0.6),
    );
    hang(rng, plan, "window", mesh, y);
}

/// Hangs two to six flat objects on the walls. Mirrors are near-mirrors, and so are half of the
/// pictures on average (glossy glass). With `specular_at_least`, more near-mirrors are hung than
/// the camera must see, as far as there is space.
pub(super) fn pictures_and_mirrors(rng: &mut Rng, plan: &mut Plan<'_>, specular_at_least: u32) {
    let wanted = if specular_at_least == 0 {
        0
    } else {
        specular_at_least + 1
    };
    let mut specular_hung = 0;
    for k in 0..(2 + rng.below(5) as u32).max(wanted + 2) {
        let must = specular_hung < wanted && k >= 1;
        let mirror = must || rng.chance(0.35);
        let specular = mirror || rng.chance(0.5);
        let (w, h) = (rng.range(0.3, 1.1), rng.range(0.3, 1.0));
        let y = rng.range(0.9, 1.6).min(plan.room.height - h - 0.1);
        let label = if mirror { "mirror" } else { "picture" };
        let depth = rng.range(0.012, 0.03);
        let mut shape = Shape::new(label);
        let m = shape.material(if specular {
            Material::mirror(label, MIRROR_ALPHA)
        } else {
            tone(rng, label, 0.15, 0.85)
        });
        shape.cuboid([-w * 0.5, 0.0, -depth * 0.5], [w * 0.5, h, depth * 0.5], m);
        if hang(rng, plan, label, shape.finish(), y) && specular {
            specular_hung += 1;
        }
    }
}
