//! The light that a light vertex sends straight to the camera.

use crate::{
    film::{slots::Film, splat::Splat, technique::Technique},
    light::light_vertices::LightVertex,
    scene::{bvh::tree::Stack, world::World},
};

/// What a light vertex sends straight to the camera. As in [`crate::one`], a point of intensity I
/// at distance d and angle θ gives I/(d² cos³θ) over the pixel's sensitive area on the film at unit
/// distance. None where the camera sees nothing of it.
pub(crate) fn splat(
    (world, film): (&World, &Film),
    (z, technique): (&LightVertex, Technique),
    stack: &mut Stack,
) -> Option<Splat> {
    let i = &world.camera.intrinsics;
    let p = z.hit.p;
    let q = world.camera.direction_to_camera(p);
    let d = p.length();
    let pixel = world.pixel(q).filter(|_| d > 0.0)?;
    let intensity = z.flux * z.hit.surface.scatter(z.hit.n, z.back, -p / d);
    if intensity == 0.0 {
        return None;
    }
    let seen = world.seen(stack, p, z.hit.n);
    if seen == 0.0 {
        return None;
    }
    let cos = q.z / d;
    let area = world.sensitive * world.sensitive;
    let value = intensity * seen * i.fx * i.fy / (d * d * cos * cos * cos) / area;
    Some(Splat {
        pixel: pixel as u32,
        slot: film.slot(z.path_m + world.metres(d)) as u32,
        spot: z.spot as u16,
        value,
        bounces: z.bounces,
        technique,
    })
}
