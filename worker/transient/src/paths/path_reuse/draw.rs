//! Draws the vertices that gather points share.

use crate::{
    film::{
        class::Place,
        sink::{PixelSink, Sink},
        slots::Film,
    },
    numeric::rng::Rng,
    paths::{
        ellipsoid::patches::Patches,
        path_reuse::{effort::Effort, shared::Shared, sharing::Sharing},
        scratch::Scratch,
        step::Step,
        tracer::{ALL, Lights, Walk},
        vertex::Vertex,
    },
    scene::{intersection::lift, stratified::Turns},
};

/// The maximum number of light vertices on unshared conductors that a gather point is connected to.
const GLOSSY: u32 = 2;

impl Sharing {
    /// Draws vertices by the scattering of gather points in turn: `count` vertices, which become
    /// candidates for shared vertices if they can be shared, and `extra` more for surfaces that
    /// cannot.
    ///
    /// Vertices that cannot be shared are walked on for their own pixel. They have most of the
    /// variance and cost little compared to the shared work. They are walked on for one in `times`
    /// of the `count`; the others are only candidates for shared vertices.
    pub(crate) fn draw_from_camera(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        (count, times, extra): (u32, u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let points = self.gathers.len();
        let alone = count / times + extra;
        let all = [Turns::new(count, rng), Turns::new(extra.max(1), rng)];
        for j in 0..count + extra {
            let shares = j < count;
            let (turns, j) = match shares {
                true => (&all[0], j),
                false => (&all[1], j - count),
            };
            let at = turns.choice(j, points);
            let whole = !shares || j % times == 0;
            let (vertex, k) = self.gathers[at];
            if !walk.goes_on(&vertex) {
                continue;
            }
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / alone as f32,
                place: Place::Gather,
            };
            let mut aims = 0.0;
            if whole {
                let images = (1.0, Some(&self.aiming));
                aims = walk.aim(rng, &vertex, images, scratch, &mut sink);
                walk.light(rng, &vertex, Lights::Glossy, GLOSSY, scratch, &mut sink);
            }
            let h = &vertex.hit;
            let Some(drawn) = turns.direction(j, &h.surface, h.n, vertex.wo, rng) else {
                continue;
            };
            let Some((mut step, mut next)) = walk.follow(&vertex, drawn, aims, &mut scratch.stack)
            else {
                continue;
            };
            next.hit.choose_lobe(rng);
            if next.hit.surface.is_black() {
                continue;
            }
            if next.hit.surface.is_shared() {
                if shares {
                    self.shared.extend(Shared::new(next.hit));
                }
            } else if whole {
                if next.hit.surface.specular() {
                    let plain = step.pdf;
                    step.pdf += walk.aims(Some(&self.aiming), h.p, &next.hit);
                    sink.factor *= plain / step.pdf;
                }
                go_on_alone((walk, effort), (step, next), rng, scratch, &mut sink);
            }
        }
    }

    /// Aims at near-mirrors from gather points in turn, `count` times, in addition to `alone`
    /// directions drawn by their scattering. Each vertex found is walked on for its own pixel.
    pub(crate) fn draw_from_mirrors(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        (count, alone): (u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let Some(all) = walk.reflectors.filter(|_| count > 0) else {
            return;
        };
        let size = film.pixel();
        let points = self.gathers.len();
        let turns = Turns::new(count, rng);
        // Gather points aim at images in the same way.
        let images = if walk.mirrors.list.is_empty() {
            0.0
        } else {
            1.0
        };
        for j in 0..count {
            let (vertex, k) = self.gathers[turns.choice(j, points)];
            if !walk.goes_on(&vertex) {
                continue;
            }
            let h = &vertex.hit;
            let Some((triangle, p)) = self.aiming.draw(all, rng) else {
                continue;
            };
            let w = (p - lift(h.p, h.n)).normalized();
            let (value, plain) = (
                h.surface.scatter(h.n, vertex.wo, w),
                h.surface.pdf(h.n, vertex.wo, w),
            );
            if !(value > 0.0 && plain > 0.0) {
                continue;
            }
            // The vertex as if it had been drawn by scattering. Russian roulette of its walk uses
            // this weight.
            let drawn = (w, value / plain, plain);
            let Some((mut step, mut next)) =
                walk.follow(&vertex, drawn, images, &mut scratch.stack)
            else {
                continue;
            };
            if next.hit.triangle != triangle {
                continue;
            }
            next.hit.choose_lobe(rng);
            if !next.hit.surface.specular() || next.hit.surface.is_black() {
                continue;
            }
            step.pdf += self.aiming.density(all, h.p, &next.hit);
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / alone as f32 * plain / step.pdf,
                place: Place::Gather,
            };
            go_on_alone((walk, effort), (step, next), rng, scratch, &mut sink);
        }
    }

    /// Draws shared vertices by the scattering of the spots in turn.
    pub(crate) fn draw_from_spots(
        &mut self,
        walk: &Walk,
        count: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let spots = &walk.emitters.list;
        let turns = Turns::new(count, rng);
        for j in 0..count {
            let spot = turns.choice(j, spots.len());
            let e = &spots[spot];
            let Some((w, weight, _)) = turns.direction(j, &e.surface, e.n, e.back, rng) else {
                continue;
            };
            let hit = walk
                .world
                .closest(&mut scratch.stack, lift(e.p, e.n), w)
                .filter(|_| weight > 0.0);
            let Some(mut hit) = hit else { continue };
            // The zones account for its light, and their densities do not include this technique.
            if walk.is_own(spot, &hit) {
                continue;
            }
            hit.choose_lobe(rng);
            self.shared.extend(Shared::new(hit));
        }
    }

    /// Draws shared vertices in the shells of a narrow gate.
    pub(crate) fn draw_in_shells(
        &mut self,
        (walk, patches): (&Walk, &Patches),
        count: u32,
        rng: &mut Rng,
    ) {
        let place = (walk.world, patches);
        self.shells
            .lay((walk.world, patches, walk.gate), &self.gathers, count);
        let start = f64::from(rng.uniform());
        for j in 0..count {
            let at = (f64::from(j) + start) / f64::from(count);
            let Some(mut hit) = self.shells.draw(place, at, rng) else {
                continue;
            };
            hit.choose_lobe(rng);
            self.shared.extend(Shared::new(hit));
        }
    }
}

/// Connects a vertex seen by one pixel to the spots, and walks on from it.
fn go_on_alone(
    (walk, effort): (&Walk, &Effort),
    (step, vertex): (Step, Vertex),
    rng: &mut Rng,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) {
    sink.at(Place::Alone);
    walk.connect(rng, &vertex, Some(&step), ALL, scratch, sink);
    sink.at(Place::AloneWalk);
    walk.run(rng, (vertex, effort.spots.1), scratch, sink);
}
