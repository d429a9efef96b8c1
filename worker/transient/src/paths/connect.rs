//! Connecting a walk's vertices: to the spots, to their images in mirrors, and to light vertices.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    film::{class::Way, sink::Sink},
    light::{caustics, contacts::Contacts, light_vertices, reflectors::Aiming},
    numeric::{rng::Rng, systematic::draw},
    paths::{
        scratch::Scratch,
        step::Step,
        tracer::{ALL, Lights, Walk},
        vertex::Vertex,
    },
    scene::{hit::Hit, intersection::lift, lobes::Seen},
};

impl Walk<'_> {
    /// Connects a vertex to `count` spots, drawn by unshadowed contribution.
    pub fn connect(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        step: Option<&Step>,
        count: u32,
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) {
        let h = &v.hit;
        if h.surface.is_black() {
            return;
        }
        let planar = self.mirrors.of(h.triangle).is_some() && step.is_some();
        let caustic =
            self.caustics.is_some() && h.surface.specular() && v.open() > h.surface.alpha();
        if caustic && !planar {
            return;
        }
        let Scratch {
            stack,
            weights,
            plain,
            images,
            ..
        } = scratch;
        let of = (Seen::of(h, v.wo), &h.surface);
        self.emitters.weights(of, plain, weights);
        if caustic {
            for &spot in &self.emitters.glossy {
                weights[spot] = 0.0;
            }
        }
        self.leave_to_zones(h, weights);
        if !self.keep_in_window(h.p, v.length_m, weights) {
            return;
        }
        if let Some(step) = step {
            self.plain_shares(step, h, weights, images);
        }
        let mut each = |spot: usize, value: f32| {
            let e = &self.emitters.list[spot];
            let free = self.world.free(stack, h.p, h.n, e.p, e.n);
            if free > 0.0 {
                let path = v.length_m + self.world.metres((e.p - h.p).length()) + e.path_m;
                let value = v.beta * value * free;
                sink.add(path, value, spot, v.bounce + 1, Way::Spot);
            }
        };
        if count == ALL {
            let lit = weights.iter().enumerate().filter(|(_, w)| **w > 0.0);
            lit.for_each(|(spot, &w)| each(spot, w));
        } else {
            draw(weights, count, rng.uniform(), each);
        }
    }

    /// Multiplies each spot's weight by the MIS weight of having reached `h` from `step` by BSDF
    /// sampling, versus aiming (mirrors) or light vertices (other surfaces).
    fn plain_shares(&self, step: &Step, h: &Hit, weights: &mut [f32], images: &mut [f32]) {
        if h.surface.specular() {
            let Some(mirror) = self.mirrors.of(h.triangle) else {
                return;
            };
            if step.aims > 0.0 {
                let total = self.mirrors.weights(step.p, step.n, images);
                for (spot, w) in weights.iter_mut().enumerate().filter(|(_, w)| **w > 0.0) {
                    let image = self.mirrors.weight(mirror, spot, step.p, step.n);
                    if image > 0.0 {
                        let aimed = self.mirrors.pdf(mirror, spot, step.p, h.p);
                        *w *= step.pdf / (step.pdf + step.aims * image / total * aimed);
                    }
                }
            }
            return;
        }
        if !self.lights {
            return;
        }
        let back = step.p - h.p;
        let b2 = back.dot(back);
        let plain = step.pdf * h.n.dot(back).abs() / (b2 * b2.sqrt());
        let strength = &self.emitters.columns.strength;
        if h.surface.diffuse() {
            // Both are Lambertian: weight = strength · f · cos cos / d², and the light vertex'
            // density is share(cos / π) · cos / d².
            let light = light_vertices::share(self.emitters, 1.0 / (PI * h.surface.lambertian()));
            for (w, &s) in weights.iter_mut().zip(&**strength) {
                let weighed = *w * plain / (plain + light * *w / s);
                *w = if s > 0.0 { weighed } else { *w };
            }
        }
        for (i, w) in weights.iter_mut().enumerate() {
            if *w > 0.0 && !(h.surface.diffuse() && strength[i] > 0.0) {
                let e = &self.emitters.list[i];
                let to = h.p - e.p;
                let d2 = to.dot(to);
                let dir = to / d2.sqrt();
                let pdf = e.surface.pdf(e.n, e.back, dir);
                let light = light_vertices::share(self.emitters, pdf) * h.n.dot(dir).abs() / d2;
                *w *= plain / (plain + light);
            }
        }
    }

    /// Connects to a spot's image in a planar mirror, `often` times on average (at most once).
    /// Returns that number, 0 without mirrors, for MIS. `aiming` is present if the vertex aims at
    /// near-mirrors as well.
    pub fn aim(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        (often, aiming): (f32, Option<&Aiming>),
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) -> f32 {
        if self.mirrors.list.is_empty() {
            return 0.0;
        }
        if often == 1.0 || rng.uniform() < often {
            self.aim_once(rng, v, (often, aiming), scratch, sink);
        }
        often
    }

    fn aim_once(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        (often, aiming): (f32, Option<&Aiming>),
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) {
        let h = &v.hit;
        let Some(aim) = self.mirrors.aim(h.p, h.n, rng, &mut scratch.images) else {
            return;
        };
        if h.n.dot(aim.target - h.p) <= 0.0 {
            return;
        }
        // The origin is the start of the ray, not `h.p`: the ray must hit the mirror at a point of
        // known density, and narrow lobes are no wider than the lift.
        let from = lift(h.p, h.n);
        let to = aim.target - from;
        let Some(m) = self.world.closest(&mut scratch.stack, from, to) else {
            return;
        };
        if self.mirrors.of(m.triangle) != Some(aim.mirror) || m.surface.is_black() {
            return;
        }
        let leg = m.p - h.p;
        let w = leg.normalized();
        let e = &self.emitters.list[aim.spot];
        let near = m.surface.gloss();
        let there = self.emitters.weight(aim.spot, m.p, m.n, -w, &near);
        let value = h.surface.scatter(h.n, v.wo, w) * there;
        let lengths = self.world.metres(leg.length()) + self.world.metres((e.p - m.p).length());
        let path = v.length_m + lengths + e.path_m;
        if value == 0.0 || !self.window.is_none_or(|w| w.holds(path)) {
            return;
        }
        let free = m.through * self.world.free(&mut scratch.stack, m.p, m.n, e.p, e.n);
        if free == 0.0 {
            return;
        }
        let aimed = often * aim.chance * self.mirrors.pdf(aim.mirror, aim.spot, h.p, m.p);
        let plain = h.surface.pdf(h.n, v.wo, w) + self.aims(aiming, h.p, &m);
        let value = v.beta * value * free / (aimed + plain);
        sink.toward(w);
        sink.add(path, value, aim.spot, v.bounce + 2, Way::Image);
    }

    /// Returns the aims at near-mirrors per steradian from `x` towards `m`, for one direction drawn
    /// by scattering.
    #[inline]
    pub fn aims(&self, aiming: Option<&Aiming>, x: Vec3, m: &Hit) -> f32 {
        let both = self.reflectors.zip(aiming);
        both.map_or(0.0, |(all, aiming)| aiming.density(all, x, m))
    }

    /// Connects a vertex to `count` light vertices of some kind, drawn by unshadowed contribution.
    /// A near-mirror is connected only to those in zones and, if the camera sees it via
    /// near-mirrors alone, to those beyond other near-mirrors that pay off there.
    pub fn light(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        which: Lights,
        count: u32,
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) {
        let h = &v.hit;
        let Scratch {
            stack,
            lights,
            plain,
            vertices,
            caustics,
            contacts,
            ..
        } = scratch;
        let vertices = match which {
            Lights::Beyond => caustics,
            Lights::Contact => contacts,
            _ => vertices,
        };
        let wanted = match which {
            Lights::All => self.lights,
            Lights::Glossy => self.lights && vertices.has_gloss(),
            Lights::Beyond => !vertices.list.is_empty(),
            Lights::Contact => {
                // Near vertices are reached by walks within the zones, and light paths continue via
                // near-mirrors.
                let theirs = |c: &Contacts| match h.surface.specular() {
                    true => v.open() > h.surface.alpha(),
                    false => c.near(self.world, h),
                };
                !vertices.list.is_empty() && !self.contacts.is_some_and(theirs)
            }
        };
        if !wanted {
            return;
        }
        if which == Lights::Glossy {
            vertices.glossy_weights(h, v.wo, lights);
        } else {
            vertices.weights(h, v.wo, (lights, plain));
        }
        if which == Lights::Beyond && h.surface.specular() {
            let below = caustics::pays_below(h.surface.alpha());
            for (w, y) in lights.iter_mut().zip(&vertices.list) {
                *w = if y.alpha < below { *w } else { 0.0 };
            }
        }
        if let Some(window) = &self.window {
            for (w, y) in lights.iter_mut().zip(&vertices.list) {
                let path = v.length_m + self.world.metres((y.hit.p - h.p).length()) + y.path_m;
                *w = if window.holds(path) { *w } else { 0.0 };
            }
        }
        let way = match which {
            Lights::All | Lights::Glossy => Way::Lit,
            Lights::Beyond => Way::Beyond,
            Lights::Contact => Way::Zone,
        };
        draw(lights, count, rng.uniform(), |i, value| {
            let y = &vertices.list[i];
            let (there, bounces) = (&y.hit, v.bounce + y.bounces);
            if bounces > self.max_bounces {
                return;
            }
            let free = self.world.free(stack, h.p, h.n, there.p, there.n);
            if free > 0.0 {
                let leg = there.p - h.p;
                let path = v.length_m + self.world.metres(leg.length()) + y.path_m;
                let w = leg.normalized();
                sink.toward(w);
                sink.add(path, v.beta * value * free, y.spot, bounces, way);
            }
        });
    }
}
