//! Draws the vertices that gather points share.

use crate::{
    film::{
        class::PathPlace,
        sink::{PixelSink, Sink},
    },
    numeric::rng::Rng,
    paths::{
        ellipsoid::patches::Patches,
        path_reuse::{
            effort::{Effort, PassContext},
            shared::Shared,
            sharing::Sharing,
        },
        scratch::Scratch,
        step::Step,
        tracer::{ALL, LightVertexKind, Tracer},
        vertex::Vertex,
    },
    scene::{intersection::lift, stratified::EvenDraws, surface::ScatterSample},
};

/// The numbers of vertices drawn from gather points.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraDraws {
    /// Vertices that become candidates for shared vertices if they can be shared.
    pub count: u32,
    /// One in this many of those that cannot be shared is walked on for its own pixel.
    pub times: u32,
    /// More vertices, for surfaces that cannot be shared.
    pub extra: u32,
}

impl Sharing {
    /// Draws vertices by the scattering of gather points in turn.
    ///
    /// Vertices that cannot be shared are walked on for their own pixel. They have most of the
    /// variance and cost little compared to the shared work.
    pub(crate) fn draw_from_camera(
        &mut self,
        context: PassContext<'_>,
        draws: CameraDraws,
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let PassContext {
            tracer,
            film,
            effort,
        } = context;
        let CameraDraws {
            count,
            times,
            extra,
        } = draws;
        let size = film.pixel();
        let points = self.gathers.len();
        let alone = count / times + extra;
        let all = [
            EvenDraws::new(count, rng),
            EvenDraws::new(extra.max(1), rng),
        ];
        for j in 0..count + extra {
            let shares = j < count;
            let (turns, j) = match shares {
                true => (&all[0], j),
                false => (&all[1], j - count),
            };
            let gather = turns.choice(j, points);
            let whole = !shares || j % times == 0;
            let (vertex, k) = self.gathers[gather];
            if !tracer.goes_on(&vertex) {
                continue;
            }
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / alone as f32,
                place: PathPlace::Gather,
            };
            let mut aims = 0.0;
            if whole {
                let images = (1.0, Some(&self.aiming));
                aims = tracer.aim(rng, &vertex, images, scratch, &mut sink);
                tracer.light(
                    rng,
                    &vertex,
                    LightVertexKind::Glossy,
                    tracer.tuning.path_reuse.glossy,
                    scratch,
                    &mut sink,
                );
            }
            let h = &vertex.hit;
            let Some(drawn) = turns.direction(j, &h.surface, h.n, vertex.wo, rng) else {
                continue;
            };
            let Some((mut step, mut next)) =
                tracer.follow(&vertex, drawn, aims, &mut scratch.stack)
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
                    step.pdf += tracer.aims(Some(&self.aiming), h.p, &next.hit);
                    sink.factor *= plain / step.pdf;
                }
                go_on_alone((tracer, effort), (step, next), rng, scratch, &mut sink);
            }
        }
    }

    /// Aims at near-mirrors from gather points in turn, `count` times, in addition to `alone`
    /// directions drawn by their scattering. Each vertex found is walked on for its own pixel.
    pub(crate) fn draw_from_mirrors(
        &mut self,
        context: PassContext<'_>,
        (count, alone): (u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let PassContext {
            tracer,
            film,
            effort,
        } = context;
        let Some(all) = tracer.reflectors.filter(|_| count > 0) else {
            return;
        };
        let size = film.pixel();
        let points = self.gathers.len();
        let turns = EvenDraws::new(count, rng);
        // Gather points aim at images in the same way.
        let images = if tracer.mirrors.list.is_empty() {
            0.0
        } else {
            1.0
        };
        for j in 0..count {
            let (vertex, k) = self.gathers[turns.choice(j, points)];
            if !tracer.goes_on(&vertex) {
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
            let drawn = ScatterSample {
                w,
                weight: value / plain,
                pdf: plain,
            };
            let Some((mut step, mut next)) =
                tracer.follow(&vertex, drawn, images, &mut scratch.stack)
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
                place: PathPlace::Gather,
            };
            go_on_alone((tracer, effort), (step, next), rng, scratch, &mut sink);
        }
    }

    /// Draws shared vertices by the scattering of the spots in turn.
    pub(crate) fn draw_from_spots(
        &mut self,
        tracer: &Tracer,
        count: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let spots = &tracer.emitters.list;
        let turns = EvenDraws::new(count, rng);
        for j in 0..count {
            let spot = turns.choice(j, spots.len());
            let e = &spots[spot];
            let Some(ScatterSample { w, weight, .. }) =
                turns.direction(j, &e.surface, e.n, e.back, rng)
            else {
                continue;
            };
            let hit = tracer
                .world
                .closest(&mut scratch.stack, lift(e.p, e.n), w)
                .filter(|_| weight > 0.0);
            let Some(mut hit) = hit else { continue };
            // The zones account for its light, and their densities do not include this technique.
            if tracer.is_own(spot, &hit) {
                continue;
            }
            hit.choose_lobe(rng);
            self.shared.extend(Shared::new(hit));
        }
    }

    /// Draws shared vertices in the shells of a narrow gate.
    pub(crate) fn draw_in_shells(
        &mut self,
        (tracer, patches): (&Tracer, &Patches),
        count: u32,
        rng: &mut Rng,
    ) {
        let place = (tracer.world, patches);
        self.shells.lay(tracer, patches, &self.gathers, count);
        let start = f64::from(rng.uniform());
        for j in 0..count {
            let position = (f64::from(j) + start) / f64::from(count);
            let Some(mut hit) = self.shells.draw(place, position, rng) else {
                continue;
            };
            hit.choose_lobe(rng);
            self.shared.extend(Shared::new(hit));
        }
    }
}

/// Connects a vertex seen by one pixel to the spots, and walks on from it.
fn go_on_alone(
    (tracer, effort): (&Tracer, &Effort),
    (step, vertex): (Step, Vertex),
    rng: &mut Rng,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) {
    sink.set_place(PathPlace::Alone);
    tracer.connect(rng, &vertex, Some(&step), ALL, scratch, sink);
    sink.set_place(PathPlace::AloneWalk);
    tracer.run(rng, (vertex, effort.spots.1), scratch, sink);
}
