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
//! near-mirror, the light paths continue as in [`crate::light::caustics`], to a point z behind it that is
//! drawn or connected likewise. They do not cover paths without a point as in condition 3 there,
//! for which [`crate::paths::vertex::Vertex::open`] is not above the near-mirror's roughness. Those are
//! sampled by connecting v to the near-mirror itself. [`crate::paths::walk`] leaves out the light from a
//! spot to its own zone, and so do the strata of two bounces if the other surface is very close
//! ([`CLOSE`]); at larger distances the strata are better than light paths. Energy is carried from
//! vertex to vertex and never divided by a distance within a zone, so it is conserved at any d.
//!
//! If a beam hits an edge exactly, rounding decides on which side of the other wall the spot is.
//! Such a spot is moved along its own surface ([`clear`]) until it is [`CLEARANCE`] away from the
//! other one.

use std::collections::HashSet;

use picofarm_scene::Vec3;

use crate::{
    light::{
        clearance::{ABOVE, ROUND, distances},
        emitter::Emitter,
        emitters::Emitters,
        light_context::Surroundings,
        light_vertices::{ALONE, LightVertex, LightVertices},
    },
    numeric::rng::Rng,
    scene::{bvh::tree::Stack, hit::Hit, intersection::lift, stratified::Turns, world::World},
};

/// Share of a spot's light that must stay in its zone for the zone to be used.
const MUCH: f32 = 1.0 / 32.0;

/// A spot gets a zone if a surface is nearer than at most this share of its distance from the
/// camera. Without a zone, the light of the spot on that surface is sampled by walks that come
/// close to it, and only by chance if a near-mirror comes before. In rooms with a spot 10 cm from a
/// box, this was most of the variance.
const NEAR: f32 = 1.0 / 12.0;

/// Number of spots above which fewer zones are better, because each spot has a small share of the
/// light. For 25 spots in furnished rooms with as many zones as for 5 spots, error² × CPU time is
/// 1.05 to 1.3 of its value without those zones. Spots are counted by their places.
const FEW: f32 = 5.0;

/// Like [`NEAR`], for zones in which light paths also sample light of two bounces.
const CLOSE: f32 = 1.0 / 64.0;

/// A zone's inner radius in units of the distance to the other surface; its least and greatest
/// value in units of the distance from the camera; and its least value in render units. Error² ×
/// CPU time varies by less than a tenth for greatest radii of 1/12 to 1/8.
const RADIUS: f32 = 8.0;
const RANGE: (f32, f32) = (1.0 / 64.0, 1.0 / 10.0);
const LEAST: f32 = 1.0 / 256.0;

/// Outer radius in units of the inner one, so that connections from vertices near the middle to
/// others have a minimum length.
const OUTER: f32 = 1.8;

/// Number of vertices of a light path before Russian roulette starts.
const SURE: u32 = 4;

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

/// All zones of a scene.
#[derive(Debug)]
pub(crate) struct Contacts {
    zones: Vec<Zone>,
    /// By surface index: whether the surface has no near-mirror.
    plain: Vec<bool>,
}

impl Contacts {
    /// Returns the zones of a scene's spots; `None` if no spot is near another surface. Spots on
    /// near-mirrors have no zone.
    pub fn find(world: &World, emitters: &Emitters) -> Option<Self> {
        let mut stack = world.bvh.stack();
        let mut zones = vec![];
        let near =
            (NEAR * FEW / places(emitters.list.iter().map(|e| e.p)) as f32).clamp(CLOSE, NEAR);
        for (spot, e) in emitters.list.iter().enumerate() {
            if e.surface.has_mirror() || e.surface.is_black() {
                continue;
            }
            if let Some((radius, close)) = radius(world, &mut stack, (e.p, e.n), near) {
                let inner2 = radius * radius;
                zones.push(Zone {
                    spot,
                    centre: e.p,
                    inner2,
                    outer2: (OUTER * radius).powi(2),
                    two2: if close { inner2 } else { 0.0 },
                });
            }
        }
        (!zones.is_empty()).then(|| Self {
            zones,
            plain: world.surfaces.iter().map(|s| !s.has_mirror()).collect(),
        })
    }

    /// Returns the number of zones: one for each source that has one.
    pub fn count(&self) -> u32 {
        self.zones.len() as u32
    }

    /// How many spots have one, those at one place counted once.
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

    /// Traces light path `l` of the `turns.count()` paths in a zone. Calls `each` with every vertex
    /// that the path may end on.
    pub fn trace(
        &self,
        within: &Surroundings<'_>,
        (zone, l, turns): (usize, u32, &Turns),
        rng: &mut Rng,
        stack: &mut Stack,
        mut each: impl FnMut(End, LightVertex),
    ) {
        let world = within.world;
        let spot = self.zones[zone].spot;
        let e: &Emitter = &within.emitters.list[spot];
        let Some((mut w, mut flux, _)) = turns.direction(l, &e.surface, e.n, e.back, rng) else {
            return;
        };
        flux /= turns.count();
        let (mut from, mut at, mut path_m) = (e.p, within.emitters.lifted[spot], e.path_m);
        // Whether the path is still within the zones, and whether the vertex before was specular.
        let (mut inside, mut specular) = (true, false);
        // Roughness of the first near-mirror on the path.
        let mut alpha = 0.0;
        for bounces in 2..=within.max_bounces {
            let Some(mut hit) = world.closest(stack, at, w) else {
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
                true => Some(End::Near),
                false if hit.surface.specular() => None,
                // Behind a near-mirror; other vertices are sampled from the camera's side.
                false if specular => Some(End::Beyond),
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
            let Some((next, mut weight, _)) = hit.surface.sample(hit.n, -w, rng) else {
                return;
            };
            if bounces > SURE {
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
            (from, at, w) = (hit.p, lift(hit.p, hit.n), next);
        }
    }

    /// Redraws the near light vertices from `count` light paths per zone, and adds those beyond
    /// near-mirrors to `beyond`.
    pub fn fill(
        &self,
        (near, beyond): (&mut LightVertices, &mut LightVertices),
        within: &Surroundings<'_>,
        count: u32,
        rng: &mut Rng,
        stack: &mut Stack,
    ) {
        near.clear();
        for zone in 0..self.zones.len() {
            let turns = Turns::new(count, rng);
            for l in 0..count {
                self.trace(within, (zone, l, &turns), rng, stack, |end, z| match end {
                    End::Near => near.push(z),
                    End::Beyond => beyond.push(z),
                });
            }
        }
    }
}

/// Returns whether there are more than [`FEW`] spots, so that each has a small share of the light.
pub(crate) fn many(emitters: &Emitters) -> bool {
    places(emitters.list.iter().map(|e| e.p)) as f32 > FEW
}

/// How many places sources have.
fn places(sources: impl Iterator<Item = Vec3>) -> usize {
    let bits = |p: Vec3| [p.x, p.y, p.z].map(f32::to_bits);
    sources.map(bits).collect::<HashSet<_>>().len()
}

/// The kinds of vertices that a zone's light path may end on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    /// A near vertex.
    Near,
    /// A vertex on the first surface behind near-mirrors.
    Beyond,
}

/// Returns the radius of a spot's zone, if it needs one: if surfaces nearer than `near` of its
/// distance from the camera receive much of its light. Also returns whether one is so close that
/// the strata of two bounces miss the strip that the spot lights.
fn radius(world: &World, stack: &mut Stack, place: (Vec3, Vec3), near: f32) -> Option<(f32, bool)> {
    let range = place.0.length();
    let (least, most) = (RANGE.0 * range, RANGE.1 * range);
    let all = distances(world, stack, place, most.max(LEAST));
    let nearest = all.iter().flatten().copied().fold(f32::INFINITY, f32::min);
    if nearest >= near * range {
        return None;
    }
    let radius = (RADIUS * nearest).clamp(least, most).max(LEAST);
    let above = all[ROUND as usize..].iter().flatten();
    let inside = above.filter(|&&t| t < radius).count();
    (inside as f32 >= MUCH * ABOVE as f32).then_some((radius, nearest < CLOSE * range))
}
