//! One pass over a tile.

use crate::{
    film::{class::Place, sink::PixelSink, slots::Film},
    numeric::{
        low_discrepancy::place,
        rng::{Rng, Stream},
    },
    paths::{
        path_reuse::{
            effort::Effort,
            gather::{Share, gather_point, only_mirrors},
            sharing::Sharing,
            tile::Tile,
        },
        scratch::Scratch,
        tracer::Walk,
    },
};

/// Camera paths per pass through near-mirrors alone, for pixels that see one. Few of them hit a
/// narrow lobe that a spot lights, and with a single path per pass that light was a rare event of
/// many times the image's error.
const MIRROR_PATHS: u32 = 16;
const SHOWING: u32 = 4;

impl Sharing {
    /// Makes one pass over a tile. `pixels` contains the slots of its pixels row by row, each as
    /// [`Film::pixel`], and the pass adds to them.
    pub fn pass(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        tile: &Tile,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let first = u64::from(tile.row) * u64::from(tile.width) + u64::from(tile.col);
        let mut rng = Rng::new(tile.seed, Stream::Paths, first, tile.pass);
        self.gathers.clear();
        self.shared.clear();
        self.arrivals.clear();
        let size = film.pixel();
        let count = effort.beyond * (pixels.len() / size) as f32;
        Self::draw_lights(walk, count.max(8.0) as u32, &mut rng, scratch);
        for (k, pixel) in pixels.chunks_mut(size).enumerate() {
            let (row, col) = (
                tile.row + k as u32 / tile.cols,
                tile.col + k as u32 % tile.cols,
            );
            let mut sink = PixelSink {
                film,
                pixel,
                factor: 1.0,
                place: Place::Mirror,
            };
            let index = u64::from(row) * u64::from(tile.width) + u64::from(col);
            let paths = match tile.mirrors[index as usize] {
                true => MIRROR_PATHS,
                false => 1,
            };
            let begin = |j: u32| {
                // Each pass samples every part of the pixel, and its first path samples a different
                // part in each pass.
                let (j, paths) = (u64::from(j), u64::from(paths));
                let path = tile.pass * paths + (j + tile.pass) % paths;
                let place = place(tile.seed, Stream::Place, index, path);
                walk.world.camera_ray((row, col), place)
            };
            let share = |j: u32| Share {
                spots: 1.0 / paths as f32,
                beyond: match j % SHOWING {
                    0 => 1.0 / paths.div_ceil(SHOWING) as f32,
                    _ => 0.0,
                },
            };
            for j in 1..paths {
                only_mirrors(walk, &mut rng, begin(j), share(j), scratch, &mut sink);
            }
            if let Some(v) = gather_point(walk, &mut rng, begin(0), share(0), scratch, &mut sink) {
                self.gathers.push((v, k));
            }
        }
        if self.gathers.is_empty() {
            return;
        }
        self.index();
        let count = (pixels.len() / size) as f32;
        if walk.lights {
            let few = effort.light_vertices.min((count * 4.0) as u32);
            let Scratch {
                vertices, stack, ..
            } = scratch;
            let of = (walk.world, walk.emitters, walk.contacts);
            vertices.fill(of, few, &mut rng, stack);
        }
        self.connect_lights((walk, film), &mut rng, scratch, pixels);
        let times = effort.candidates;
        let drawn = |share: f32| (count * share).round().max(1.0) as u32;
        let (camera, light) = (drawn(effort.camera), drawn(effort.light));
        let extra = camera * effort.extra;
        let (camera, light) = (camera * times, light * times);
        let alone = camera / times + extra;
        let aims = self.aim((walk, effort), alone, count);
        let on = (walk, film, effort);
        self.draw_from_camera(on, (camera, times, extra), &mut rng, scratch, pixels);
        self.draw_from_mirrors(on, (aims, alone), &mut rng, scratch, pixels);
        self.draw_from_spots(walk, light, &mut rng, scratch);
        if let Some(patches) = walk.patches {
            self.draw_in_shells((walk, patches), drawn(effort.shell), &mut rng);
        }
        if times > 1 {
            let kept = (camera + light) / times;
            self.choose(walk, (kept, (camera, light)), &mut rng, scratch);
        }
        self.connect((walk, film, effort), (camera, light), &mut rng, scratch);
        self.gloss.lay(&self.shared, &self.arrivals);
        self.spread((walk, film), pixels);
    }

    /// Weighs the near-mirrors that this tile's `pixels` gather points aim at. Returns the number
    /// of aims, in addition to `alone` directions drawn by scattering.
    pub fn aim(&mut self, (walk, effort): (&Walk, &Effort), alone: u32, pixels: f32) -> u32 {
        self.aiming.clear();
        let Some(all) = walk.reflectors else { return 0 };
        let aims = (effort.aims * pixels).ceil();
        let points = self.gathers.iter().map(|(v, _)| (v.hit.p, v.hit.n));
        match self.aiming.weigh(all, aims / alone as f32, points) {
            true => aims as u32,
            false => 0,
        }
    }
}
