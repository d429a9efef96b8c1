//! What a generated scene's camera and laser must see: bounded depth over the whole image, enough to
//! look at, and every beam landing on a diffuse surface.

use crate::{Camera, Intrinsics, Laser, Material, Object, Vec3, trace::World};

/// Smallest z-depth of a furnished room's view, metres.
pub const MIN_DEPTH_M: f32 = 0.5;
/// Largest z-depth of a furnished room's view, metres.
pub const MAX_DEPTH_M: f32 = 4.5;

/// Pixels along the longer side of the image by which a view is accepted. It is the same for every image
/// size: a seed shows the same view at 64 pixels as at 1,024.
const ACCEPTED_AT: u32 = 256;
/// Rows and columns of the coarse look before the full check.
const COARSE: u32 = 24;
/// Mirrors that a beam may meet before it has to land.
const MAX_FOLDS: usize = 8;

/// Intrinsics by which the view of an image of `width` × `height` pixels is accepted.
pub(crate) fn acceptance(fov_x_deg: f32, width: u32, height: u32) -> Intrinsics {
    let longer = width.max(height).max(1);
    let side = |pixels: u32| {
        let scaled = u64::from(pixels) * u64::from(ACCEPTED_AT) + u64::from(longer / 2);
        u32::try_from(scaled / u64::from(longer)).map_or(1, |n| n.max(1))
    };
    Intrinsics::from_fov(fov_x_deg, side(width), side(height))
}

/// Pixels of the coarse look (of COARSE²) that see each object; `None` where any lies outside the
/// bounds of z-depth. The film's corners are looked at too, since extremes tend to lie there.
pub(crate) fn coarse_view(
    world: &World,
    camera: &Camera,
    bounds: [f32; 2],
    objects: usize,
) -> Option<Vec<u32>> {
    let i = &camera.intrinsics;
    let (w, h) = (i.width as f32, i.height as f32);
    for [x, y] in [
        [0.5, 0.5],
        [w - 0.5, 0.5],
        [0.5, h - 0.5],
        [w - 0.5, h - 0.5],
    ] {
        bounded(world, camera, bounds, x, y)?;
    }
    let mut seen = vec![0; objects];
    for row in 0..COARSE {
        for column in 0..COARSE {
            let x = (column as f32 + 0.5) / COARSE as f32 * w;
            let y = (row as f32 + 0.5) / COARSE as f32 * h;
            seen[bounded(world, camera, bounds, x, y)?.0] += 1;
        }
    }
    Some(seen)
}

/// Smallest and largest z-depth over every pixel centre; `None` where one lies outside the bounds.
pub(crate) fn full_view(world: &World, camera: &Camera, bounds: [f32; 2]) -> Option<[f32; 2]> {
    let i = &camera.intrinsics;
    let (mut near, mut far) = (f32::INFINITY, 0.0f32);
    for v in 0..i.height {
        for u in 0..i.width {
            let (_, depth) = bounded(world, camera, bounds, u as f32 + 0.5, v as f32 + 0.5)?;
            (near, far) = (near.min(depth), far.max(depth));
        }
    }
    Some([near, far])
}

/// Object and z-depth at a film position, if within the bounds.
fn bounded(
    world: &World,
    camera: &Camera,
    [near, far]: [f32; 2],
    x: f32,
    y: f32,
) -> Option<(usize, f32)> {
    // Camera rays have z-component 1, so the ray parameter is the z-depth.
    let hit = world.closest(camera.origin, camera.ray(x, y))?;
    (near..=far).contains(&hit.t).then_some((hit.object, hit.t))
}

/// True if every beam ends on a diffuse surface, straight or folded by mirrors.
pub(crate) fn beams_land(world: &World, laser: &Laser, objects: &[Object]) -> bool {
    laser
        .beams
        .iter()
        .all(|beam| lands(world, laser.origin, beam.direction, objects))
}

fn lands(world: &World, mut origin: Vec3, mut direction: Vec3, objects: &[Object]) -> bool {
    for _ in 0..MAX_FOLDS {
        let Some(hit) = world.closest(origin, direction) else {
            return false;
        };
        let mesh = &objects[hit.object].mesh;
        let material = mesh.triangle_material[hit.triangle as usize];
        if !mesh.materials[material as usize].is_specular() {
            return true;
        }
        let normal = world.normal(hit, direction);
        origin = origin + direction * hit.t + normal * 1e-4;
        direction = direction - normal * (2.0 * direction.dot(normal));
    }
    false
}

/// True for objects with a specular material.
pub(crate) fn is_specular(object: &Object) -> bool {
    object.mesh.materials.iter().any(Material::is_specular)
}
