//! Walks: random paths onward from a vertex.
//!
//! The vertices of a walk connect to the spots and to light vertices and, if the scene has planar
//! near-mirrors, aim at the spots' images in them. All techniques are weighted by multiple
//! importance sampling (balance heuristic, Veach and Guibas 1995).

mod connect;

pub(crate) use self::connect::draw;

use picofarm_scene::Vec3;

use crate::{
    api::Gate,
    bvh::Stack,
    by_glass::ByGlass,
    caustic::{Caustics, Surroundings},
    contact::Contacts,
    ellipsoid::{Patches, Window},
    emitter::Emitters,
    light_vertices::LightVertices,
    mirror_images::Mirrors,
    reflectors::Reflectors,
    rng::Rng,
    sink::Sink,
    vertex::Vertex,
    world::{Hit, World, lift},
};

/// The scene and the settings in which paths are traced.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Walk<'a> {
    pub world: &'a World,
    pub emitters: &'a Emitters,
    pub mirrors: &'a Mirrors,
    pub gate: &'a Gate,
    /// Longest path in bounces.
    pub max_bounces: u32,
    /// Whether walks connect to light vertices.
    pub lights: bool,
    /// Light paths via near-mirrors, if they pay off.
    pub caustics: Option<&'a Caustics>,
    /// Near-mirrors that gather points aim at, if aiming pays off.
    pub reflectors: Option<&'a Reflectors>,
    /// Glass that refracts light, if there is any.
    pub glass: Option<&'a ByGlass>,
    /// Zones around spots close to other surfaces, if there are any.
    pub contacts: Option<&'a Contacts>,
    /// Length of the shortest path from the laser to a spot, metres.
    pub shortest_m: f64,
    /// The path lengths that count with a narrow gate. Other contributions are discarded.
    pub window: Option<Window>,
    /// The patches on which shared vertices are drawn for a narrow gate.
    pub patches: Option<&'a Patches>,
}

/// How a vertex was reached, for MIS.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step {
    p: Vec3,
    n: Vec3,
    /// Density per steradian of the direction taken, summed over all techniques that can draw it.
    pub pdf: f32,
    /// Expected number of aims at `p`.
    aims: f32,
}

/// Kinds of light vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Lights {
    /// All vertices that spots light directly.
    All,
    /// Directly lit vertices on unshared conductors, for vertices that a tile's shared vertices
    /// serve as well.
    Glossy,
    /// Vertices beyond near-mirrors.
    Beyond,
    /// Vertices in the zones of spots close to other surfaces.
    Contact,
}

/// Buffers of one thread's walks.
#[derive(Debug)]
pub(crate) struct Scratch {
    pub stack: Stack,
    /// Weights of spots.
    pub weights: Vec<f32>,
    /// Weights of the spots' images in mirrors.
    images: Vec<f32>,
    /// Weights of light vertices.
    lights: Vec<f32>,
    /// Densities for `lights` or for weights of spots.
    pub plain: Vec<f32>,
    /// Light vertices that walks connect to.
    pub vertices: LightVertices,
    /// Light vertices beyond near-mirrors.
    pub caustics: LightVertices,
    /// Light vertices in the zones of spots close to other surfaces.
    pub contacts: LightVertices,
}

impl Scratch {
    pub fn new(world: &World, emitters: &Emitters, mirrors: &Mirrors) -> Self {
        Self {
            stack: world.bvh.stack(),
            weights: vec![0.0; emitters.list.len()],
            images: vec![0.0; mirrors.choices()],
            lights: vec![],
            plain: vec![],
            vertices: LightVertices::default(),
            caustics: LightVertices::default(),
            contacts: LightVertices::default(),
        }
    }
}

/// The maximum number of spots that a camera vertex is connected to. This number and those below
/// were chosen by error² × CPU time on the reference rooms, where the optimum is flat (2, 4 and 12
/// spots: 7.2, 5.7 and 6.0 on room-diffuse). More connections from one vertex also correlate
/// neighbouring bins of a pixel, so that errors of sums over bins exceed the estimate from the
/// bins' own errors.
pub(crate) const SPOTS: u32 = 4;
/// Connects to every spot.
pub(crate) const ALL: u32 = u32::MAX;
/// The maximum number of light vertices that a camera vertex is connected to.
const LIGHTS: u32 = 2;
/// Aims at images per vertex of a walk. Such a vertex matters less than a gather point and costs as
/// much.
const AIMS: f32 = 0.25;
/// Russian roulette continues a path with a probability of this multiple of its throughput.
const SURVIVAL: f32 = 1.5;

impl Walk<'_> {
    /// Returns the part of this walk's state that light paths are traced in.
    #[inline]
    pub fn surroundings(&self) -> Surroundings<'_> {
        Surroundings {
            world: self.world,
            emitters: self.emitters,
            mirrors: self.mirrors,
            gate: self.gate,
            max_bounces: self.max_bounces,
        }
    }

    /// Returns true if a path with one more vertex and a spot can still count.
    #[inline]
    pub fn goes_on(&self, v: &Vertex) -> bool {
        !v.hit.surface.is_black()
            && v.bounce + 2 <= self.max_bounces
            && v.length_m + self.shortest_m < self.gate.end_m()
            && self.in_time(v.hit.p, v.length_m)
    }

    /// Returns false if a narrow gate ends before the shortest path via `p`.
    #[inline]
    pub fn in_time(&self, p: Vec3, length_m: f64) -> bool {
        self.window
            .is_none_or(|w| length_m + self.emitters.shortest_m(self.world, p) < w.end_m)
    }

    /// Zeroes the weights of spots if their path via a surface point misses a narrow gate. Returns
    /// whether any weight is left.
    pub fn keep_in_window(&self, p: Vec3, length_m: f64, weights: &mut [f32]) -> bool {
        if self.window.is_none() {
            return true;
        }
        let mut any = false;
        for (spot, w) in weights.iter_mut().enumerate().filter(|(_, w)| **w > 0.0) {
            if self.in_window(p, length_m, spot) {
                any = true;
            } else {
                *w = 0.0;
            }
        }
        any
    }

    /// Returns whether a path from a spot with a weight via a surface point can count.
    pub fn any_in_window(&self, p: Vec3, length_m: f64, weights: &[f32]) -> bool {
        let mut lit = weights.iter().enumerate().filter(|(_, w)| **w > 0.0);
        self.window.is_none() || lit.any(|(spot, _)| self.in_window(p, length_m, spot))
    }

    #[inline]
    fn in_window(&self, p: Vec3, length_m: f64, spot: usize) -> bool {
        let e = &self.emitters.list[spot];
        let path = length_m + self.world.metres((e.p - p).length()) + e.path_m;
        self.window.is_none_or(|w| w.holds(path))
    }

    /// Returns whether a vertex lit by a spot belongs to the spot's zone.
    #[inline]
    pub fn is_own(&self, spot: usize, h: &Hit) -> bool {
        self.contacts.is_some_and(|c| c.own(self.world, spot, h))
    }

    /// Zeroes the weights of spots if the zones account for their light at `h`.
    #[inline]
    pub fn leave_to_zones(&self, h: &Hit, weights: &mut [f32]) {
        if let Some(contacts) = self.contacts {
            contacts.leave_out(self.world, h, weights);
        }
    }

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
