//! Ground truth from the rays through the pixels' centres.

use picofarm_scene::Scene;
use rayon::prelude::*;

use crate::{
    api::{GroundTruth, RenderError, Stop},
    light::{emitter::Emitter, emitters::Emitters},
    scene::{centres::Centres, hit::Hit, world::World},
};

/// Returns everything except the companion image, and the number of rays traced. Visibility is per
/// beam; a beam without a spot lights nothing.
pub(crate) fn ground_truth(
    scene: &Scene,
    (world, emitters): (&World, &Emitters),
    centres: &Centres,
    beams: usize,
    stop: Stop,
) -> Result<(GroundTruth, u64), RenderError> {
    let i = world.camera.intrinsics;
    let count = i.width as usize * i.height as usize;
    let mut truth = GroundTruth {
        depth: vec![0.0; count],
        range: vec![0.0; count],
        normal: vec![0.0; 3 * count],
        instance: vec![0; count],
        label: vec![0; count],
        specular: vec![0; count],
        visibility: vec![0; beams * count],
        rgb: vec![],
    };
    for (k, hit) in centres.hits.iter().enumerate() {
        let Some(h) = hit else { continue };
        let q = world.camera.direction_to_camera(h.p);
        // Rays at right angles to the axis are rounded to either side of it.
        truth.depth[k] = world.metres(q.z).max(0.0) as f32;
        truth.range[k] = world.metres(h.p.length()) as f32;
        let n = world.camera.direction_to_camera(h.n);
        truth.normal[3 * k..3 * k + 3].copy_from_slice(&<[f32; 3]>::from(n));
        let object = world.object[h.triangle as usize];
        truth.instance[k] = object + 1;
        truth.label[k] = scene.objects[object as usize].label + 1;
        let glass = world.body(h.triangle).is_some();
        truth.specular[k] = u8::from(glass || h.surface.specular());
    }
    let mut rays = 0;
    for e in places(emitters) {
        let plane = &mut truth.visibility[e.beam * count..(e.beam + 1) * count];
        rays += plane
            .par_chunks_mut(i.width as usize)
            .enumerate()
            .map(|(row, out)| match stop.asked() {
                true => 0,
                false => lit(world, e, row, &centres.hits, out),
            })
            .sum::<u64>();
        stop.check()?;
    }
    Ok((truth, rays))
}

/// Returns one source per spot. The sources of a spot's parts are at the same position and
/// consecutive. Spots of light that glass deflected are not in the ground truth.
fn places(emitters: &Emitters) -> impl Iterator<Item = &Emitter> {
    let runs = emitters.list.chunk_by(|a, b| a.beam == b.beam);
    runs.filter_map(|run| run.iter().find(|e| !e.aside))
}

/// Writes which pixels of a row a spot lights. Returns the number of rays traced.
fn lit(world: &World, e: &Emitter, row: usize, hits: &[Option<Hit>], out: &mut [u8]) -> u64 {
    let mut stack = world.bvh.stack();
    let first = row * out.len();
    for (lit, hit) in out.iter_mut().zip(&hits[first..]) {
        let Some(h) = hit else { continue };
        let to = e.p - h.p;
        // Points on the spot's own wall see the spot at a right angle, up to rounding.
        let slack = 1e-3 * to.length();
        let facing = h.n.dot(to) > -slack && e.n.dot(to) < slack;
        *lit = u8::from(facing && world.free(&mut stack, h.p, h.n, e.p, e.n) > 0.0);
    }
    stack.rays
}

/// Returns the approximate number of rays of the truth in addition to the centres', from every
/// `step`-th row.
pub(crate) fn rays(world: &World, emitters: &Emitters, centres: &Centres, step: usize) -> u64 {
    let width = world.camera.intrinsics.width as usize;
    let rows = (0..world.camera.intrinsics.height as usize).step_by(step);
    let some: u64 = rows
        .flat_map(|row| places(emitters).map(move |e| (row, e)))
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|(row, e)| lit(world, e, row, &centres.hits, &mut vec![0; width]))
        .sum();
    some * step as u64
}
