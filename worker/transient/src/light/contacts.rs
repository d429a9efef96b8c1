//! Zones around spots near another surface: the light of a spot on a surface close to it.
//!
//! A spot at a small distance d from a wall sends up to half of its light to a strip of that wall
//! about d wide, and the light goes on from there. No camera path finds the strip, and as d falls
//! the variance grows without bound, although the energy stays finite. So two balls are set around
//! such a spot, its *zone*, and paths are divided into two classes by geometry alone. Call a vertex
//! *near* if it is within a zone's outer radius and its material has no near-mirror. A path belongs
//! to the zones if the first vertex after its spot is near and within the inner radius of that
//! spot's own zone. Let v be the last vertex of the run of near vertices that begins there.
//!
//! Light paths from the spots cover that class. They walk within the zones, and each of their
//! vertices may be v: it is drawn into the image if the camera sees it, and it is a light vertex
//! ([`crate::light::light_vertices`]) for camera vertices that are not near. If the run ends on a
//! near-mirror, the light paths continue as in [`crate::light::caustics`], to a point z behind it
//! that is drawn or connected likewise. They do not cover paths without a point as in condition 3
//! there, for which [`crate::paths::vertex::Vertex::open`] is not above the near-mirror's
//! roughness. Those are sampled by connecting v to the near-mirror itself. [`crate::paths::walk`]
//! leaves out the light from a spot to its own zone, and so do the strata of two bounces if the
//! other surface is very close ([`ContactTuning::close`]); at larger distances the strata are
//! better than light paths. Energy is carried from vertex to vertex and never divided by a distance
//! within a zone, so it is conserved at any d.

use std::collections::HashSet;

use picofarm_scene::Vec3;

use crate::{
    film::{splat::Splat, technique::Technique},
    light::{
        clearance::{ABOVE, ROUND, distances},
        emitter::Emitter,
        emitters::Emitters,
        light_context::LightContext,
        light_vertices::{ALONE, LightVertex, LightVertices},
        splat::splat,
        splat_source::{SplatPass, SplatSource},
    },
    numeric::rng::{Rng, Stream},
    scene::{
        bvh::tree::Stack, hit::Hit, intersection::lift, stratified::EvenDraws,
        surface::ScatterSample, world::World,
    },
    tuning::ContactTuning,
};

/// A spot with a zone.
#[derive(Debug, Clone, Copy)]
struct Zone {
    /// Emitter index.
    spot: usize,
    centre: Vec3,
    /// Squares of the inner and the outer radius.
    inner2: f32,
    outer2: f32,
    /// Square of the radius within which light paths also sample light of two bounces.
    two2: f32,
}

impl Zone {
    #[inline]
    fn distance2(&self, p: Vec3) -> f32 {
        let to = p - self.centre;
        to.dot(to)
    }
}

/// A light path in a zone.
#[derive(Clone, Copy)]
pub(crate) struct ZonePath<'a> {
    /// Index of the zone.
    pub zone: usize,
    /// Index of the path among the `draws.count()` paths of the zone.
    pub index: u32,
    pub draws: &'a EvenDraws,
}

/// All zones of a scene.
#[derive(Debug)]
pub(crate) struct Contacts {
    zones: Vec<Zone>,
    /// By surface index: whether the surface has no near-mirror.
    plain: Vec<bool>,
    pub tuning: ContactTuning,
}

impl Contacts {
    /// Returns the zones of a scene's spots; `None` if no spot is near another surface. Spots on
    /// near-mirrors have no zone.
    pub fn find(world: &World, emitters: &Emitters, tuning: ContactTuning) -> Option<Self> {
        let mut stack = world.bvh.stack();
        let mut zones = vec![];
        let near = (tuning.near * tuning.few / places(emitters.list.iter().map(|e| e.p)) as f32)
            .clamp(tuning.close, tuning.near);
        for (spot, e) in emitters.list.iter().enumerate() {
            if e.surface.has_mirror() || e.surface.is_black() {
                continue;
            }
            if let Some((radius, close)) = radius(world, &mut stack, (e.p, e.n), near, &tuning) {
                let inner2 = radius * radius;
                zones.push(Zone {
                    spot,
                    centre: e.p,
                    inner2,
                    outer2: (tuning.outer * radius).powi(2),
                    two2: if close { inner2 } else { 0.0 },
                });
            }
        }
        (!zones.is_empty()).then(|| Self {
            zones,
            plain: world.surfaces.iter().map(|s| !s.has_mirror()).collect(),
            tuning,
        })
    }

    /// Returns the number of zones: one for each source that has one.
    pub fn count(&self) -> u32 {
        self.zones.len() as u32
    }

    /// Returns the number of spots with a zone; spots at one place count once.
    pub fn spots(&self) -> usize {
        places(self.zones.iter().map(|z| z.centre))
    }

    fn plain(&self, world: &World, h: &Hit) -> bool {
        self.plain[world.surface[h.triangle as usize] as usize]
    }

    /// Returns whether a vertex is near.
    #[inline]
    pub fn near(&self, world: &World, h: &Hit) -> bool {
        let inside = |z: &Zone| z.distance2(h.p) < z.outer2;
        self.zones.iter().any(inside) && self.plain(world, h)
    }

    /// Returns whether a vertex is near and within the inner radius of a spot's own zone. If that
    /// spot lights it, the path belongs to the zones.
    #[inline]
    pub fn own(&self, world: &World, spot: usize, h: &Hit) -> bool {
        let inside = |z: &Zone| z.spot == spot && z.distance2(h.p) < z.inner2;
        self.zones.iter().any(inside) && self.plain(world, h)
    }

    /// Clears the weights of spots if the vertex is near and within the inner radius of their own
    /// zone.
    #[inline]
    pub fn leave_out(&self, world: &World, h: &Hit, weights: &mut [f32]) {
        for z in &self.zones {
            if z.distance2(h.p) < z.inner2 && self.plain(world, h) {
                weights[z.spot] = 0.0;
            }
        }
    }

    /// Clears the weights of spots if the zones' light paths draw their light at this camera hit
    /// into the image.
    #[inline]
    pub fn leave_out_of_two(&self, world: &World, h: &Hit, weights: &mut [f32]) {
        for z in &self.zones {
            if z.distance2(h.p) < z.two2 && self.plain(world, h) {
                weights[z.spot] = 0.0;
            }
        }
    }

    /// Returns whether a light path's near vertex is drawn into the image. For two bounces it is
    /// drawn only if no other technique samples that light.
    pub fn draws(&self, y: &LightVertex) -> bool {
        let own = |z: &&Zone| z.spot == y.spot;
        y.bounces > 2 || (self.zones.iter().filter(own)).any(|z| z.distance2(y.hit.p) < z.two2)
    }

    /// Traces a light path in a zone. Calls `each` with every vertex that the path may end on.
    pub fn trace(
        &self,
        within: &LightContext<'_>,
        path: ZonePath<'_>,
        rng: &mut Rng,
        stack: &mut Stack,
        mut each: impl FnMut(ZoneEnd, LightVertex),
    ) {
        let ZonePath {
            zone,
            index: l,
            draws: turns,
        } = path;
        let world = within.world;
        let spot = self.zones[zone].spot;
        let e: &Emitter = &within.emitters.list[spot];
        let Some(ScatterSample {
            mut w,
            weight: mut flux,
            ..
        }) = turns.direction(l, &e.surface, e.n, e.back, rng)
        else {
            return;
        };
        flux /= turns.count();
        let (mut from, mut start, mut path_m) = (e.p, within.emitters.lifted[spot], e.path_m);
        // Whether the path is still within the zones, and whether the vertex before was specular.
        let (mut inside, mut specular) = (true, false);
        // Roughness of the first near-mirror on the path.
        let mut alpha = 0.0;
        for bounces in 2..=within.max_bounces {
            let Some(mut hit) = world.closest(stack, start, w) else {
                return;
            };
            let near = match bounces {
                2 if !self.own(world, spot, &hit) => return,
                _ => inside && self.near(world, &hit),
            };
            hit.choose_lobe(rng);
            path_m += world.metres((hit.p - from).length());
            flux *= hit.through;
            if flux == 0.0 || hit.surface.is_black() || path_m > within.gate.end_m() {
                return;
            }
            let end = match near {
                true => Some(ZoneEnd::Near),
                false if hit.surface.specular() => None,
                // Behind a near-mirror; other vertices are sampled from the camera's side.
                false if specular => Some(ZoneEnd::Beyond),
                false => return,
            };
            inside = near;
            if let Some(end) = end {
                let vertex = LightVertex {
                    hit,
                    back: -w,
                    flux,
                    density: ALONE,
                    path_m,
                    spot,
                    bounces,
                    alpha,
                };
                each(end, vertex);
            }
            let Some(ScatterSample {
                w: next,
                mut weight,
                ..
            }) = hit.surface.sample(hit.n, -w, rng)
            else {
                return;
            };
            if bounces > self.tuning.sure {
                let survive = weight.min(0.95);
                if rng.uniform() >= survive {
                    return;
                }
                weight /= survive;
            }
            flux *= weight;
            specular = hit.surface.specular();
            if specular && alpha == 0.0 {
                alpha = hit.surface.alpha();
            }
            (from, start, w) = (hit.p, lift(hit.p, hit.n), next);
        }
    }

    /// Redraws the near light vertices from `count` light paths per zone, and adds those beyond
    /// near-mirrors to `beyond`.
    pub fn fill(
        &self,
        (near, beyond): (&mut LightVertices, &mut LightVertices),
        within: &LightContext<'_>,
        count: u32,
        rng: &mut Rng,
        stack: &mut Stack,
    ) {
        near.clear();
        for zone in 0..self.zones.len() {
            let turns = EvenDraws::new(count, rng);
            for l in 0..count {
                self.trace(
                    within,
                    ZonePath {
                        zone,
                        index: l,
                        draws: &turns,
                    },
                    rng,
                    stack,
                    |end, z| match end {
                        ZoneEnd::Near => near.push(z),
                        ZoneEnd::Beyond => beyond.push(z),
                    },
                );
            }
        }
    }
}

/// Returns whether there are more than [`ContactTuning::few`] spots, so that each has a small share
/// of the light.
pub(crate) fn many(emitters: &Emitters, tuning: &ContactTuning) -> bool {
    places(emitters.list.iter().map(|e| e.p)) as f32 > tuning.few
}

/// Returns the number of distinct places of sources.
fn places(sources: impl Iterator<Item = Vec3>) -> usize {
    let bits = |p: Vec3| [p.x, p.y, p.z].map(f32::to_bits);
    sources.map(bits).collect::<HashSet<_>>().len()
}

/// The kinds of vertices that a zone's light path may end on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ZoneEnd {
    /// A near vertex.
    Near,
    /// A vertex on the first surface behind near-mirrors.
    Beyond,
}

/// Returns the radius of a spot's zone, if it needs one: if surfaces nearer than `near` of its
/// distance from the camera receive much of its light. Also returns whether one is so close that
/// the strata of two bounces miss the strip that the spot lights.
fn radius(
    world: &World,
    stack: &mut Stack,
    place: (Vec3, Vec3),
    near: f32,
    tuning: &ContactTuning,
) -> Option<(f32, bool)> {
    let range = place.0.length();
    let (least, most) = (tuning.least_range * range, tuning.most_range * range);
    let all = distances(world, stack, place, most.max(tuning.least));
    let nearest = all.iter().flatten().copied().fold(f32::INFINITY, f32::min);
    if nearest >= near * range {
        return None;
    }
    let radius = (tuning.radius * nearest)
        .clamp(least, most)
        .max(tuning.least);
    let above = all[ROUND as usize..].iter().flatten();
    let inside = above.filter(|&&t| t < radius).count();
    (inside as f32 >= tuning.much * ABOVE as f32)
        .then_some((radius, nearest < tuning.close * range))
}

impl SplatSource for Contacts {
    fn splats(&self, pass: &SplatPass<'_>, out: &mut Vec<Splat>) -> u64 {
        let context = &pass.context;
        let (least, most) = (self.tuning.least_paths, self.tuning.most_paths);
        let share = pass.width * pass.height / self.tuning.pixels_per_path / self.count();
        let count = (share.clamp(least, most) / pass.fraction.one_in).max(1);
        let zone = |stack: &mut Stack, zone: u32, ends: &mut Vec<Splat>| {
            let number = u64::from(pass.pass);
            let mut rng = Rng::new(pass.seed, Stream::Contact, u64::from(zone), number);
            let draws = EvenDraws::new(count, &mut rng);
            let mut seen = vec![];
            for index in 0..count {
                let path = ZonePath {
                    zone: zone as usize,
                    index,
                    draws: &draws,
                };
                self.trace(context, path, &mut rng, stack, |end, z| {
                    if end == ZoneEnd::Beyond || self.draws(&z) {
                        seen.push(z);
                    }
                });
                let image = (context.world, pass.film);
                let found = seen.drain(..);
                ends.extend(found.flat_map(|z| splat(image, (&z, Technique::Zone), stack)));
            }
        };
        pass.side_by_side(self.count(), out, zone)
    }
}
