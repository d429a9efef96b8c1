//! Walks: random paths onward from a vertex.
//!
//! The vertices of a walk connect to the spots and to light vertices and, if the scene has planar
//! near-mirrors, aim at the spots' images in them. All techniques are weighted by multiple
//! importance sampling (balance heuristic, Veach and Guibas 1995).

use picofarm_scene::Vec3;

use crate::{
    film::sink::Sink,
    numeric::rng::Rng,
    paths::{
        scratch::Scratch,
        step::Step,
        tracer::{Lights, SPOTS, Walk},
        vertex::Vertex,
    },
    scene::{bvh::tree::Stack, intersection::lift},
};

/// The maximum number of light vertices that a camera vertex is connected to.
const LIGHTS: u32 = 2;

/// Aims at images per vertex of a walk. Such a vertex matters less than a gather point and costs as
/// much.
const AIMS: f32 = 0.25;

/// Russian roulette continues a path with a probability of this multiple of its throughput.
const SURVIVAL: f32 = 1.5;

impl Walk<'_> {
    /// Walks on from a vertex and finds everything beyond it except its own connection to the
    /// spots. The next vertex is connected to at most `spots` of them, later ones to at most
    /// [`SPOTS`].
    pub fn run(
        &self,
        rng: &mut Rng,
        (from, mut spots): (Vertex, u32),
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) {
        let mut vertex = from;
        while self.goes_on(&vertex) {
            let helped = !vertex.hit.surface.specular();
            let mut aims = 0.0;
            if helped {
                aims = self.aim(rng, &vertex, (AIMS, None), scratch, sink);
                self.light(rng, &vertex, Lights::All, LIGHTS, scratch, sink);
                self.light(rng, &vertex, Lights::Beyond, LIGHTS, scratch, sink);
            }
            self.light(rng, &vertex, Lights::Contact, LIGHTS, scratch, sink);
            let Some((step, next)) = self.step(rng, &vertex, aims, true, &mut scratch.stack) else {
                return;
            };
            sink.leave(-next.wo);
            vertex = next;
            self.connect(rng, &vertex, helped.then_some(&step), spots, scratch, sink);
            spots = SPOTS;
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
        let (w, mut weight, pdf) = h.surface.sample(h.n, v.wo, rng)?;
        if roulette {
            let survive = (SURVIVAL * v.beta * weight).min(0.95);
            if rng.uniform() >= survive {
                return None;
            }
            weight /= survive;
        }
        let (step, mut next) = self.follow(v, (w, weight, pdf), aims, stack)?;
        next.hit.choose_lobe(rng);
        Some((step, next))
    }

    /// Takes one step in a given direction: (direction, f·cos/pdf, pdf per steradian).
    pub fn follow(
        &self,
        v: &Vertex,
        (w, weight, pdf): (Vec3, f32, f32),
        aims: f32,
        stack: &mut Stack,
    ) -> Option<(Step, Vertex)> {
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
            sight: v.next(),
        };
        Some((step, next))
    }
}
