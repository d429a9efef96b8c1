//! Light vertices of a pass, and the connections of gather points to them.

use crate::{
    film::{
        class::{Connection, PathPlace},
        sink::PixelSink,
        slots::Film,
    },
    light::contacts::Contacts,
    numeric::rng::Rng,
    paths::{
        path_reuse::sharing::Sharing,
        scratch::Scratch,
        tracer::{LightVertexKind, Tracer},
        vertex::Vertex,
    },
    scene::intersection::lift,
};

impl Sharing {
    /// Draws the light vertices of this pass: those beyond near-mirrors by `count` paths, and those
    /// in the zones of spots close to other surfaces.
    pub(crate) fn draw_lights(tracer: &Tracer, count: u32, rng: &mut Rng, scratch: &mut Scratch) {
        let Scratch {
            caustics: beyond,
            contacts: near,
            stack,
            ..
        } = scratch;
        beyond.clear();
        near.clear();
        let within = tracer.surroundings();
        if let Some(caustics) = tracer.caustics {
            caustics.fill(beyond, &within, count, rng, stack);
        }
        if let Some(contacts) = tracer.contacts {
            let tuning = &contacts.tuning;
            let (least, most) = (tuning.least_tile_paths, tuning.most_tile_paths);
            let count = (tuning.tile_paths / contacts.count()).clamp(least, most);
            contacts.fill((near, beyond), &within, count, rng, stack);
        }
    }

    /// Connects the gather points to the light vertices of [`Sharing::draw_lights`].
    pub(crate) fn connect_lights(
        &mut self,
        (tracer, film): (&Tracer, &Film),
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
                    place: PathPlace::Gather,
                };
                tracer.light(
                    rng,
                    v,
                    LightVertexKind::Beyond,
                    tracer.tuning.path_reuse.beyond,
                    scratch,
                    &mut sink,
                );
            }
        }
        if let Some(contacts) = tracer.contacts {
            self.connect_near((tracer, film), contacts, scratch, pixels);
        }
    }

    /// Connects every gather point that is not near a zone to every light vertex in a zone, with
    /// one narrow bundle of rays each.
    pub fn connect_near(
        &mut self,
        (tracer, film): (&Tracer, &Film),
        contacts: &Contacts,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let Scratch {
            contacts: near,
            stack,
            ..
        } = scratch;
        let far = |v: &Vertex| !contacts.near(tracer.world, &v.hit);
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
                if value > 0.0 && bounces <= tracer.max_bounces {
                    self.weight[i] = v.beta * y.flux * value / d2;
                    self.segments.push(i, lift(v.hit.p, v.hit.n));
                }
            }
            let from = lift(y.hit.p, y.hit.n);
            self.segments.trace(tracer.world, stack, from);
            for (i, through) in self.segments.found() {
                let Some(through) = through else { continue };
                let (v, k) = &self.gathers[i];
                let leg = tracer.world.metres((y.hit.p - v.hit.p).length());
                let path = v.length_m + leg + y.path_m;
                if tracer.window.is_none_or(|w| w.holds(path)) {
                    let pixel = &mut pixels[k * size..(k + 1) * size];
                    let spot = film.tag(y.spot, PathPlace::Gather, Connection::Zone);
                    film.add(pixel, film.slot(path), self.weight[i] * through, spot);
                }
            }
        }
    }
}
