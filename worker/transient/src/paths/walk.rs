//! Walks: random paths onward from a vertex.
//!
//! The vertices of a walk connect to the spots and to light vertices and, if the scene has planar
//! near-mirrors, aim at the spots' images in them. All techniques are weighted by multiple
//! importance sampling (balance heuristic, Veach and Guibas 1995).

use crate::{
    film::sink::Sink,
    numeric::rng::Rng,
    paths::{
        scratch::Scratch,
        step::Step,
        tracer::{LightVertexKind, Tracer},
        vertex::Vertex,
    },
    scene::{bvh::tree::Stack, intersection::lift, surface::ScatterSample},
};

impl Tracer<'_> {
    /// Walks on from a vertex and finds everything beyond it except its own connection to the
    /// spots. The next vertex is connected to at most `spots` of them, later ones to at most
    /// [`WalkTuning::spots`](crate::tuning::WalkTuning).
    pub fn run(
        &self,
        rng: &mut Rng,
        (from, mut spots): (Vertex, u32),
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) {
        let tuning = &self.tuning.walk;
        let mut vertex = from;
        while self.goes_on(&vertex) {
            let helped = !vertex.hit.surface.specular();
            let mut aims = 0.0;
            if helped {
                aims = self.aim(rng, &vertex, (tuning.aims, None), scratch, sink);
                self.light(
                    rng,
                    &vertex,
                    LightVertexKind::All,
                    tuning.light_vertices,
                    scratch,
                    sink,
                );
                self.light(
                    rng,
                    &vertex,
                    LightVertexKind::Beyond,
                    tuning.light_vertices,
                    scratch,
                    sink,
                );
            }
            self.light(
                rng,
                &vertex,
                LightVertexKind::Contact,
                tuning.light_vertices,
                scratch,
                sink,
            );
            let Some((step, next)) = self.step(rng, &vertex, aims, true, &mut scratch.stack) else {
                return;
            };
            sink.leave(-next.wo);
            vertex = next;
            self.connect(rng, &vertex, helped.then_some(&step), spots, scratch, sink);
            spots = tuning.spots;
        }
    }

    /// Takes one step by the surface's own scattering, with Russian roulette if requested.
    pub fn step(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        aims: f32,
        roulette: bool,
        stack: &mut Stack,
    ) -> Option<(Step, Vertex)> {
        let h = v.hit;
        let mut drawn = h.surface.sample(h.n, v.wo, rng)?;
        if roulette {
            let survive = (self.tuning.walk.survival * v.beta * drawn.weight).min(0.95);
            if rng.uniform() >= survive {
                return None;
            }
            drawn.weight /= survive;
        }
        let (step, mut next) = self.follow(v, drawn, aims, stack)?;
        next.hit.choose_lobe(rng);
        Some((step, next))
    }

    /// Takes one step in a given direction.
    pub fn follow(
        &self,
        v: &Vertex,
        drawn: ScatterSample,
        aims: f32,
        stack: &mut Stack,
    ) -> Option<(Step, Vertex)> {
        let ScatterSample { w, weight, pdf } = drawn;
        let h = v.hit;
        let hit = self.world.closest(stack, lift(h.p, h.n), w)?;
        let step = Step {
            p: h.p,
            n: h.n,
            pdf,
            aims,
        };
        let next = Vertex {
            hit,
            wo: -w,
            beta: v.beta * weight * hit.through,
            length_m: v.length_m + self.world.metres((hit.p - h.p).length()),
            bounce: v.bounce + 1,
            sight: v.next(&self.tuning.caustics),
        };
        Some((step, next))
    }
}
