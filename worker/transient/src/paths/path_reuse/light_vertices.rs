//! Light vertices of a pass, and the connections of gather points to them.

use crate::{
    film::{
        class::{Place, Way},
        sink::PixelSink,
        slots::Film,
    },
    light::contacts::Contacts,
    numeric::rng::Rng,
    paths::{
        path_reuse::sharing::Sharing,
        scratch::Scratch,
        tracer::{Lights, Walk},
        vertex::Vertex,
    },
    scene::intersection::lift,
};

/// The maximum number of light vertices beyond near-mirrors that a gather point is connected to.
const BEYOND: u32 = 2;

/// Light paths per pass in all zones near spots, and the minimum and maximum in one zone.
const ALL_ZONES: u32 = 64;
const ZONE_PATHS: (u32, u32) = (4, 16);

impl Sharing {
    /// Draws the light vertices of this pass: those beyond near-mirrors by `count` paths, and those
    /// in the zones of spots close to other surfaces.
    pub(crate) fn draw_lights(walk: &Walk, count: u32, rng: &mut Rng, scratch: &mut Scratch) {
        let Scratch {
            caustics: beyond,
            contacts: near,
            stack,
            ..
        } = scratch;
        beyond.clear();
        near.clear();
        let within = walk.surroundings();
        if let Some(caustics) = walk.caustics {
            caustics.fill(beyond, &within, count, rng, stack);
        }
        if let Some(contacts) = walk.contacts {
            let (least, most) = ZONE_PATHS;
            let count = (ALL_ZONES / contacts.count()).clamp(least, most);
            contacts.fill((near, beyond), &within, count, rng, stack);
        }
    }

    /// Connects the gather points to the light vertices of [`draw_lights`].
    pub(crate) fn connect_lights(
        &mut self,
        (walk, film): (&Walk, &Film),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        if !scratch.caustics.list.is_empty() {
            for (v, k) in &self.gathers {
                let mut sink = PixelSink {
                    film,
                    pixel: &mut pixels[k * size..(k + 1) * size],
                    factor: 1.0,
                    place: Place::Gather,
                };
                walk.light(rng, v, Lights::Beyond, BEYOND, scratch, &mut sink);
            }
        }
        if let Some(contacts) = walk.contacts {
            self.connect_near((walk, film, contacts), scratch, pixels);
        }
    }

    /// Connects every gather point that is not near a zone to every light vertex in a zone, with
    /// one narrow bundle of rays each.
    pub fn connect_near(
        &mut self,
        (walk, film, contacts): (&Walk, &Film, &Contacts),
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let Scratch {
            contacts: near,
            stack,
            ..
        } = scratch;
        let far = |v: &Vertex| !contacts.near(walk.world, &v.hit);
        let far: Vec<bool> = self.gathers.iter().map(|(v, _)| far(v)).collect();
        self.weight.clear();
        self.weight.resize(self.gathers.len(), 0.0);
        for y in &near.list {
            self.segments.clear();
            for (i, (v, _)) in self.gathers.iter().enumerate().filter(|&(i, _)| far[i]) {
                let bounces = v.bounce + y.bounces;
                let to = y.hit.p - v.hit.p;
                let d2 = to.dot(to);
                let w = to / d2.sqrt();
                let value = v.hit.surface.scatter(v.hit.n, v.wo, w)
                    * y.hit.surface.scatter(y.hit.n, y.back, -w);
                if value > 0.0 && bounces <= walk.max_bounces {
                    self.weight[i] = v.beta * y.flux * value / d2;
                    self.segments.push(i, lift(v.hit.p, v.hit.n));
                }
            }
            let from = lift(y.hit.p, y.hit.n);
            self.segments.trace(walk.world, stack, from);
            for (i, through) in self.segments.found() {
                let Some(through) = through else { continue };
                let (v, k) = &self.gathers[i];
                let leg = walk.world.metres((y.hit.p - v.hit.p).length());
                let path = v.length_m + leg + y.path_m;
                if walk.window.is_none_or(|w| w.holds(path)) {
                    let pixel = &mut pixels[k * size..(k + 1) * size];
                    let spot = film.tag(y.spot, Place::Gather, Way::Zone);
                    film.add(pixel, film.slot(path), self.weight[i] * through, spot);
                }
            }
        }
    }
}
