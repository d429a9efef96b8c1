//! Light that comes by way of near-mirrors, found from the spots' side.
//!
//! A camera path finds a spot in a curved near-mirror only by chance, and likewise a spot behind two
//! mirrors. Light paths go there by themselves. So that no path is counted twice, paths are parted in
//! two *classes*, by geometry alone. Call an event *specular* where the light leaves by a near-mirror's
//! lobe (a mix of two lobes counts as the lobe that scattered). A path belongs to light paths where
//!
//! 1. read from the spot, one or more specular events s₁ … sⱼ are followed by another surface point z;
//! 2. it is not the case that j = 1, s₁ lies on a planar mirror that [`crate::mirror_images`] knows and the spot is
//!    Lambertian: those have images to aim at;
//! 3. z, or a later point that is no near-mirror's, is what the camera sees directly; or the event before it (read from
//!    the camera) is not specular; or the camera sees it by way of near-mirrors alone, of which the last is not much smoother than s₁
//!    ([`pays_below`]).
//!
//! Light paths cover that class and nothing else. Let z be the first point of which 3 holds: it is drawn into the image
//! where the camera sees it, and is a light vertex ([`crate::light_vertices`]) for every other point. A light path goes on
//! from z by the surface's own scattering, and ends unless it meets a near-mirror: a caustic that diffuse surfaces see by
//! way of a near-mirror is covered as well. [`crate::walk`] leaves out just these: [`crate::vertex::Vertex::open`] carries
//! condition 3 along a camera path. A near-mirror that the camera sees connects to z by its own narrow lobe: many light vertices are
//! looked at from many camera paths, so that some lie within it. What is left to chance is light that comes to the camera by near-mirrors
//! alone, and caustics that it sees in much smoother ones.
//!
//! The first leg goes to a point on a near-mirror, chosen by its unshadowed light, or along the spot's own
//! scattering, joined by the balance heuristic.

use picofarm_scene::Vec3;

use crate::{
    api::{Gate, Stop},
    bvh::Stack,
    emitter::Emitters,
    film::Film,
    light_vertices::{ALONE, LightVertex, LightVertices},
    mirror_images::Mirrors,
    rng::{Rng, Stream},
    sink::Technique,
    targets::{Drawn, Target, Targets},
    world::{Hit, World, lift},
};

/// Events before Russian roulette sets in.
const SURE: u32 = 3;
/// How much smoother than the first near-mirror of a light path the one may be in which the camera sees its end. Chance finds such
/// light, from the camera, more seldom the smoother the first one is; connecting, the smoother the other one. But thousands
/// of pairs are looked at there.
const SMOOTHER: f32 = 16.0;
/// Paths of the probe, and the share of the spots' power that must come by near-mirrors to pay. In a furnished room where it is
/// 8·10⁻⁴ to 1.6·10⁻³ (the upper edge of a mirror on the wall, 2 mm deep) chance found a path that brought 0.7 % of the image's
/// light to one pixel; light paths cost 2 % of the time there at 64×64 and 10 % at 24×24. With 1.4·10⁻⁴ no such path was met.
const PROBE: u32 = 4096;
const PAYS: f64 = 3e-4;

/// What light paths are traced in.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surroundings<'a> {
    pub world: &'a World,
    pub emitters: &'a Emitters,
    pub mirrors: &'a Mirrors,
    pub gate: &'a Gate,
    /// Longest path in bounces.
    pub max_bounces: u32,
}

/// Near-mirrors as targets of light paths.
#[derive(Debug)]
pub(crate) struct Caustics {
    /// Triangles with a near-mirror's lobe.
    triangles: Vec<u32>,
    /// Place in `triangles` by triangle, [`NONE`] for most.
    place: Vec<u32>,
    /// How to aim at them.
    targets: Targets,
}

const NONE: u32 = u32::MAX;

/// One light path's contribution to the image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Splat {
    /// Row-major pixel.
    pub pixel: u32,
    /// Slot of the film.
    pub slot: u32,
    /// Emitter.
    pub spot: u16,
    /// Radiance averaged over the pixel, render units.
    pub value: f32,
    /// Bounces of the whole path.
    pub bounces: u32,
    pub technique: Technique,
}

/// How many of a batch of light paths begin which way.
#[derive(Debug, Clone, Copy)]
struct Shares {
    aimed: u32,
    plain: u32,
}

/// The first leg: spot, point on the near-mirror, unit direction back, flux there, path from the laser.
struct Start {
    spot: usize,
    hit: Hit,
    back: Vec3,
    flux: f32,
    path_m: f64,
}

/// Roughness that the first near-mirror of light paths must be below for them to pay where the camera sees their end in a
/// near-mirror of roughness `alpha`.
#[inline]
pub(crate) fn pays_below(alpha: f32) -> f32 {
    SMOOTHER * alpha
}

impl Caustics {
    /// The near-mirrors of a scene; `None` where there are none.
    pub fn find(world: &World, emitters: &Emitters, stop: Stop) -> Option<Self> {
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
        })
    }

    fn shares(&self, count: u32) -> Shares {
        let plain = if self.targets.any() { count / 4 } else { count };
        Shares {
            aimed: count - plain,
            plain,
        }
    }

    /// Light path `l` of a batch of `count`: calls `each` with every surface point z that it may end on. The sum over the
    /// batch is an estimate.
    pub fn trace(
        &self,
        within: &Surroundings<'_>,
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
        let aimed_at = images && within.mirrors.of(hit.triangle).is_some();
        // The spot and the first event.
        let (mut bounces, mut ended) = (2, false);
        while bounces < within.max_bounces && path_m < within.gate.end_m() {
            let Some((w, mut weight, _)) = hit.surface.sample(hit.n, wo, rng) else {
                return;
            };
            if ended || bounces > SURE {
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
            // What is left by another lobe and meets no near-mirror is found from the camera's side, and a single planar
            // mirror by its images.
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
        within: &Surroundings<'_>,
        count: u32,
        rng: &mut Rng,
        stack: &mut Stack,
    ) {
        for l in 0..count {
            self.trace(within, (l, count), rng, stack, |z| vertices.push(z));
        }
    }

    /// The leg from a spot to a near-mirror.
    fn start(
        &self,
        within: &Surroundings<'_>,
        (l, shares): (u32, Shares),
        rng: &mut Rng,
        stack: &mut Stack,
    ) -> Option<Start> {
        let (world, emitters) = (within.world, within.emitters);
        let spots = emitters.list.len();
        let (spot, mut hit) = if l < shares.aimed {
            let at = (f64::from(l) + f64::from(rng.uniform())) / f64::from(shares.aimed);
            let Drawn { spot, target, p } = self.targets.draw(at, || rng.uniform())?;
            let t = self.triangles[target];
            let from = emitters.lifted[spot];
            let hit = world.closest(stack, from, p - from)?;
            if hit.triangle != t {
                return None;
            }
            (spot, hit)
        } else {
            let at = (l - shares.aimed) as f32 + rng.uniform();
            let at = at / shares.plain as f32 * spots as f32;
            let spot = (at as usize).min(spots - 1);
            let e = &emitters.list[spot];
            let (w, _, _) = e.surface.sample(e.n, e.back, rng)?;
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

    /// True where the spots send a share of their power by near-mirrors that makes light paths pay.
    pub fn pay(&self, within: &Surroundings<'_>, seed: u64) -> bool {
        let mut stack = within.world.bvh.stack();
        let mut rng = Rng::new(seed, Stream::Caustic, 0, u64::MAX);
        let mut flux = 0.0;
        for l in 0..PROBE {
            let mut first = None;
            self.trace(within, (l, PROBE), &mut rng, &mut stack, |z| {
                first.get_or_insert(z.flux);
            });
            flux += first.map_or(0.0, f64::from);
        }
        flux > PAYS * within.emitters.list.len() as f64
    }
}

/// What a light vertex sends straight to the camera. As in [`crate::one`], a point of intensity I at
/// distance d and angle θ gives I/(d² cos³θ) over the pixel's sensitive area on the film at unit distance. None where the
/// camera sees nothing of it.
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
