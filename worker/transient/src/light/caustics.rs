//! Light paths for light that arrives via near-mirrors.
//!
//! A camera path hits a spot in a curved near-mirror only by chance, and likewise a spot behind two
//! mirrors. Light paths reach these points directly. So that no path is counted twice, paths are
//! divided into two *classes*, by geometry alone. Call an event *specular* if the light leaves by a
//! near-mirror's lobe (a mix of two lobes counts as the lobe that scattered). A path belongs to
//! light paths if
//!
//! 1. read from the spot, one or more specular events s₁ … sⱼ are followed by another surface point
//!    z;
//! 2. it is not the case that j = 1, s₁ is on a planar mirror known to
//!    [`crate::light::mirror_images`] and the spot is Lambertian, because such paths aim at mirror
//!    images;
//! 3. there is a point p, either z or a later point off near-mirrors, with one of these properties:
//!    the camera sees p directly; or the event before p (read from the camera) is not specular; or
//!    the camera sees p via near-mirrors alone, and the last of them is not much smoother than s₁
//!    ([`CausticTuning::smoother`]).
//!
//! Light paths cover that class and nothing else. Let z be the first such p. It is drawn into the
//! image if the camera sees it, and it is a light vertex ([`crate::light::light_vertices`]) for
//! every other point. A light path continues from z by the surface's own scattering, and ends
//! unless it hits a near-mirror, so a caustic that diffuse surfaces see via a near-mirror is
//! covered as well. [`crate::paths::walk`] leaves out exactly these paths:
//! [`crate::paths::vertex::Vertex::open`] carries condition 3 along a camera path. A near-mirror
//! that the camera sees connects to z by its own narrow lobe: many camera paths test many light
//! vertices, so that some of these are within the lobe. Two kinds of light are left to chance:
//! light that reaches the camera via near-mirrors alone, and caustics seen in much smoother
//! near-mirrors.
//!
//! The first leg goes to a point on a near-mirror, chosen by its unshadowed light, or along the
//! spot's own scattering, combined by the balance heuristic.

use picofarm_scene::Vec3;

use crate::{
    api::Stop,
    film::{splat::Splat, technique::Technique},
    light::{
        emitters::Emitters,
        light_context::LightContext,
        light_vertices::{ALONE, LightVertex, LightVertices},
        splat::splat,
        splat_source::{CHUNK, SplatPass, SplatSource},
        targets::{AimedPoint, Target, Targets},
    },
    numeric::rng::{Rng, Stream},
    scene::{bvh::tree::Stack, hit::Hit, intersection::lift, surface::ScatterSample, world::World},
    tuning::CausticTuning,
};

/// Near-mirrors as targets of light paths.
#[derive(Debug)]
pub(crate) struct Caustics {
    /// Triangles with a near-mirror's lobe.
    triangles: Vec<u32>,
    /// By triangle: its index in `triangles`, [`NONE`] for most.
    place: Vec<u32>,
    /// The sampler that aims at them.
    targets: Targets,
    pub tuning: CausticTuning,
}

const NONE: u32 = u32::MAX;

/// The numbers of light paths of a batch by the way they start.
#[derive(Debug, Clone, Copy)]
struct PathCounts {
    aimed: u32,
    plain: u32,
}

/// The first leg: spot, point on the near-mirror, unit direction back, flux there, and path length
/// from the laser.
struct Start {
    spot: usize,
    hit: Hit,
    back: Vec3,
    flux: f32,
    path_m: f64,
}

impl Caustics {
    /// Returns the near-mirrors of a scene; `None` if there are none.
    pub fn find(
        world: &World,
        emitters: &Emitters,
        tuning: CausticTuning,
        stop: Stop,
    ) -> Option<Self> {
        let narrow = |t: usize| {
            let surface = &world.surfaces[world.surface[t] as usize];
            surface.has_mirror() && world.normals[t] != Vec3::ZERO
        };
        let all = 0..world.triangles.len();
        let triangles: Vec<u32> = all.filter(|&t| narrow(t)).map(|t| t as u32).collect();
        if triangles.is_empty() || emitters.list.is_empty() {
            return None;
        }
        let mut place = vec![NONE; world.triangles.len()];
        let mut all = vec![];
        for (k, &t) in triangles.iter().enumerate() {
            place[t as usize] = k as u32;
            all.push(Target {
                corners: world.triangles[t as usize],
                normal: world.normals[t as usize],
                two_sided: world.surfaces[world.surface[t as usize] as usize].two_sided(),
                counts: world.counts(t as usize),
                share: 1.0,
            });
        }
        Some(Self {
            triangles,
            place,
            targets: Targets::new(&all, emitters, stop)?,
            tuning,
        })
    }

    fn shares(&self, count: u32) -> PathCounts {
        let plain = if self.targets.any() { count / 4 } else { count };
        PathCounts {
            aimed: count - plain,
            plain,
        }
    }

    /// Traces light path `l` of a batch of `count`. Calls `each` with every surface point z that
    /// the path may end on. The sum over the batch is an estimate.
    pub fn trace(
        &self,
        within: &LightContext<'_>,
        (l, count): (u32, u32),
        rng: &mut Rng,
        stack: &mut Stack,
        mut each: impl FnMut(LightVertex),
    ) {
        let world = within.world;
        let Some(start) = self.start(within, (l, self.shares(count)), rng, stack) else {
            return;
        };
        let Start {
            spot,
            mut hit,
            back: mut wo,
            mut flux,
            mut path_m,
        } = start;
        let images = within.emitters.columns.strength[spot] > 0.0;
        let alpha = hit.surface.alpha();
        let aimed_at = images && within.mirrors.of_triangle(hit.triangle).is_some();
        // Counts the spot and the first event.
        let (mut bounces, mut ended) = (2, false);
        while bounces < within.max_bounces && path_m < within.gate.end_m() {
            let Some(ScatterSample { w, mut weight, .. }) = hit.surface.sample(hit.n, wo, rng)
            else {
                return;
            };
            if ended || bounces > self.tuning.sure {
                let survive = weight.min(0.95);
                if rng.uniform() >= survive {
                    return;
                }
                weight /= survive;
            }
            flux *= weight;
            let Some(mut next) = world.closest(stack, lift(hit.p, hit.n), w) else {
                return;
            };
            next.choose_lobe(rng);
            path_m += world.metres((next.p - hit.p).length());
            flux *= next.through;
            let before = hit.surface.specular();
            (hit, wo) = (next, -w);
            bounces += 1;
            if hit.surface.is_black() || flux == 0.0 {
                return;
            }
            if hit.surface.specular() {
                continue;
            }
            // Light that left by another lobe and hits no near-mirror is sampled from the camera's
            // side, and light via a single planar mirror by mirror images.
            if !before || (bounces == 3 && aimed_at) {
                return;
            }
            ended = true;
            each(LightVertex {
                hit,
                back: wo,
                flux,
                density: ALONE,
                path_m,
                spot,
                bounces,
                alpha,
            });
        }
    }

    /// Adds light vertices beyond near-mirrors, from `count` light paths.
    pub fn fill(
        &self,
        vertices: &mut LightVertices,
        within: &LightContext<'_>,
        count: u32,
        rng: &mut Rng,
        stack: &mut Stack,
    ) {
        for l in 0..count {
            self.trace(within, (l, count), rng, stack, |z| vertices.push(z));
        }
    }

    /// Draws the leg from a spot to a near-mirror.
    fn start(
        &self,
        within: &LightContext<'_>,
        (l, shares): (u32, PathCounts),
        rng: &mut Rng,
        stack: &mut Stack,
    ) -> Option<Start> {
        let (world, emitters) = (within.world, within.emitters);
        let spots = emitters.list.len();
        let (spot, mut hit) = if l < shares.aimed {
            let position = (f64::from(l) + f64::from(rng.uniform())) / f64::from(shares.aimed);
            let AimedPoint { spot, target, p } = self.targets.draw(position, || rng.uniform())?;
            let t = self.triangles[target];
            let from = emitters.lifted[spot];
            let hit = world.closest(stack, from, p - from)?;
            if hit.triangle != t {
                return None;
            }
            (spot, hit)
        } else {
            let position = (l - shares.aimed) as f32 + rng.uniform();
            let position = position / shares.plain as f32 * spots as f32;
            let spot = (position as usize).min(spots - 1);
            let e = &emitters.list[spot];
            let w = e.surface.sample(e.n, e.back, rng)?.w;
            (spot, world.closest(stack, emitters.lifted[spot], w)?)
        };
        let k = self.place[hit.triangle as usize];
        hit.choose_lobe(rng);
        if k == NONE || !hit.surface.specular() || hit.surface.is_black() {
            return None;
        }
        let e = &emitters.list[spot];
        let to = hit.p - e.p;
        let d2 = to.dot(to);
        let d = d2.sqrt();
        let w = to / d;
        let turn = hit.n.dot(w).abs() / d2;
        let aimed = shares.aimed as f32 * self.targets.density(spot, k as usize);
        let plain = shares.plain as f32 / spots as f32 * e.surface.pdf(e.n, e.back, w) * turn;
        let density = aimed + plain;
        let flux = e.intensity(w) * turn * hit.through / density;
        (density > 0.0 && flux > 0.0).then(|| Start {
            spot,
            hit,
            back: -w,
            flux,
            path_m: e.path_m + world.metres(d),
        })
    }

    /// Returns whether the spots send enough of their power via near-mirrors for light paths to
    /// pay.
    pub fn pay(&self, within: &LightContext<'_>, seed: u64) -> bool {
        let mut stack = within.world.bvh.stack();
        let mut rng = Rng::new(seed, Stream::Caustic, 0, u64::MAX);
        let enough = self.tuning.pays * within.emitters.list.len() as f64;
        let mut flux = 0.0;
        for l in 0..self.tuning.probe {
            let mut first = None;
            self.trace(within, (l, self.tuning.probe), &mut rng, &mut stack, |z| {
                first.get_or_insert(z.flux);
            });
            // The sum only grows, so the paths that are left cannot change the answer.
            flux += first.map_or(0.0, f64::from);
            if flux > enough {
                return true;
            }
        }
        false
    }
}

impl SplatSource for Caustics {
    fn splats(&self, pass: &SplatPass<'_>, out: &mut Vec<Splat>) -> u64 {
        let context = &pass.context;
        let count = pass.light_paths(self.tuning.paths);
        let chunk = |stack: &mut Stack, chunk: u32, ends: &mut Vec<Splat>| {
            let number = u64::from(pass.pass);
            let mut rng = Rng::new(pass.seed, Stream::Caustic, u64::from(chunk), number);
            let mut seen = vec![];
            for l in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                self.trace(context, (l, count), &mut rng, stack, |z| seen.push(z));
                let image = (context.world, pass.film);
                let found = seen.drain(..);
                ends.extend(found.flat_map(|z| splat(image, (&z, Technique::Mirrors), stack)));
            }
        };
        pass.side_by_side(count.div_ceil(CHUNK), out, chunk)
    }
}
