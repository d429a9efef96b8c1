//! The requirements on a generated scene's camera and laser: bounded depth over the whole image,
//! enough visible objects, and every beam ending on a diffuse surface.

use crate::{Bsdf, Camera, Intrinsics, Laser, Material, Object, Vec3, trace::World};

/// The smallest z-depth of a furnished room's view, metres.
pub const MIN_DEPTH_M: f32 = 0.5;
/// The largest z-depth of a furnished room's view, metres.
pub const MAX_DEPTH_M: f32 = 4.5;

/// The number of pixels along the longer side of the image for the acceptance test. It is the same
/// for every image size, so a seed shows the same view at 64 pixels as at 1,024.
const ACCEPTED_AT: u32 = 256;
/// The number of rows and columns of the coarse test before the full one.
const COARSE: u32 = 24;
/// The greatest number of mirrors and surfaces of glass bodies on a beam's path before it must end.
const MAX_FOLDS: usize = 8;

/// Returns the intrinsics for the acceptance test of an image of `width` × `height` pixels.
pub(crate) fn acceptance(fov_x_deg: f32, width: u32, height: u32) -> Intrinsics {
    let longer = width.max(height).max(1);
    let side = |pixels: u32| {
        let scaled = u64::from(pixels) * u64::from(ACCEPTED_AT) + u64::from(longer / 2);
        u32::try_from(scaled / u64::from(longer)).map_or(1, |n| n.max(1))
    };
    Intrinsics::from_fov(fov_x_deg, side(width), side(height))
}

/// Returns the number of pixels of the coarse test (of COARSE²) that see each object, or `None` if
/// any z-depth is out of bounds. The film's corners are tested too, because extremes tend to be
/// there.
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

/// Returns the smallest and largest z-depth over every pixel centre, or `None` if one is out of
/// bounds.
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

/// Returns the object and z-depth at a film position, if within the bounds.
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

/// Returns whether every beam ends on a diffuse surface: straight, folded by mirrors or refracted
/// by glass bodies.
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
        let material = &mesh.materials[material as usize];
        if !material.is_specular() {
            return true;
        }
        let at = origin + direction * hit.t;
        let normal = world.normal(hit, direction);
        let refracted = match material.bsdf {
            Bsdf::Dielectric { ior, .. } => {
                // There is air in front of the facet, and glass behind it.
                let enters = world.facing(hit).dot(direction) <= 0.0;
                refracted(direction, normal, if enters { 1.0 / ior } else { ior })
            }
            _ => None,
        };
        (origin, direction) = match refracted {
            Some(through) => (at - normal * 1e-4, through),
            None => (
                at + normal * 1e-4,
                direction - normal * (2.0 * direction.dot(normal)),
            ),
        };
    }
    false
}

/// Returns the unit direction behind a surface by Snell's law. The surface's unit normal must be
/// turned against the unit `direction`. `ratio` is the index of refraction in front of the surface
/// over the index behind it. Returns `None` for total reflection.
fn refracted(direction: Vec3, normal: Vec3, ratio: f32) -> Option<Vec3> {
    let cos = -direction.dot(normal);
    let square = 1.0 - ratio * ratio * (1.0 - cos * cos);
    (square > 0.0)
        .then(|| (direction * ratio + normal * (ratio * cos - square.sqrt())).normalized())
}

/// Returns whether an object has a specular material.
pub(crate) fn is_specular(object: &Object) -> bool {
    object.mesh.materials.iter().any(Material::is_specular)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{Affine, Mesh, shape::Shape, trace::Model};

    const GLASS: Bsdf = Bsdf::Dielectric {
        ior: 1.5,
        transmittance: 1.0,
    };

    fn solid(bsdf: Bsdf, build: impl FnOnce(&mut Shape, u32)) -> Mesh {
        let mut shape = Shape::new("solid");
        let m = shape.material(Material {
            bsdf,
            ..Material::diffuse("solid", [0.5; 3])
        });
        build(&mut shape, m);
        shape.finish()
    }

    /// Returns whether a beam along +z from the origin ends on a diffuse surface.
    fn beam_lands(meshes: Vec<Mesh>) -> bool {
        let mut world = World::default();
        let place = |mesh| {
            let model = Arc::new(Model::new(mesh).expect("has triangles"));
            world.add(model.clone(), Affine::IDENTITY);
            Object {
                mesh: model.mesh.clone(),
                to_world: Affine::IDENTITY,
                label: 0,
                name: String::new(),
            }
        };
        let objects: Vec<Object> = meshes.into_iter().map(place).collect();
        lands(&world, Vec3::ZERO, Vec3::new(0.0, 0.0, 1.0), &objects)
    }

    #[test]
    fn light_is_refracted_by_snells_law_and_goes_on_as_it_came_behind_a_slab() {
        let n = Vec3::new(0.0, 0.0, -1.0);
        for k in 0..9 {
            let sin = k as f32 * 0.12;
            let came = Vec3::new(sin, 0.0, (1.0 - sin * sin).sqrt());
            let inside = refracted(came, n, 1.0 / 1.5).expect("enters");
            assert!((inside.x * 1.5 - sin).abs() < 1e-6, "{inside:?}");
            let left = refracted(inside, n, 1.5).expect("leaves");
            assert!((left - came).length() < 1e-6, "{left:?}");
            // The sine of the critical angle is 1/1.5.
            assert_eq!(refracted(came, n, 1.5).is_none(), sin > 1.0 / 1.5);
        }
    }

    #[test]
    fn beams_land_behind_a_body_of_glass_where_refraction_leads() {
        let wall = |[lo, hi]: [f32; 2], z: f32| {
            let diffuse = Bsdf::Diffuse { reflectance: 0.5 };
            solid(diffuse, |s, m| {
                s.cuboid([-9.0, lo, z], [9.0, hi, z + 0.1], m);
            })
        };
        let slab = || {
            solid(GLASS, |s, m| {
                s.cuboid([-1.0, -1.0, 1.0], [1.0, 1.0, 1.5], m)
            })
        };
        assert!(beam_lands(vec![slab(), wall([-9.0, 9.0], 3.0)]));
        assert!(!beam_lands(vec![slab()]));
        // A ball above the beam deflects it upwards, towards the ball's axis.
        let ball = || {
            solid(GLASS, |s, m| {
                s.ellipsoid(Vec3::new(0.003, 0.5, 2.0), [1.0, 1.0], 64, m)
            })
        };
        assert!(beam_lands(vec![ball(), wall([0.5, 9.0], 5.0)]));
        assert!(!beam_lands(vec![ball(), wall([-9.0, 0.5], 5.0)]));
        // A prism deflects it downwards by total reflection: 45° exceeds the critical angle.
        let prism = solid(GLASS, |s, m| {
            let (a, b, c) = ([-1.0, 1.0], [-1.0, 3.0], [1.0, 1.0]);
            let at = |x: f32, [y, z]: [f32; 2]| Vec3::new(x, y, z);
            let (l, r) = (-1.0, 1.0);
            s.quad([at(l, a), at(r, a), at(r, b), at(l, b)], m);
            s.quad([at(l, a), at(l, c), at(r, c), at(r, a)], m);
            s.quad([at(l, b), at(r, b), at(r, c), at(l, c)], m);
            s.quad([at(l, a), at(l, b), at(l, c), at(l, c)], m);
            s.quad([at(r, a), at(r, c), at(r, b), at(r, b)], m);
        });
        crate::body::check_mesh(&prism).expect("a body");
        let floor = solid(Bsdf::Diffuse { reflectance: 0.5 }, |s, m| {
            s.cuboid([-9.0, -3.1, -9.0], [9.0, -3.0, 9.0], m);
        });
        assert!(beam_lands(vec![prism.clone(), floor]));
        assert!(!beam_lands(vec![prism, wall([-9.0, 9.0], 5.0)]));
    }
}
