//! Walks: random paths onward from a vertex, whose vertices connect to the spots and to light vertices
//! and, where the scene has planar near-mirrors, aim at the spots' images in them. All are weighed by
//! multiple importance sampling (balance heuristic, Veach and Guibas 1995).

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    api::Gate,
    bvh::Stack,
    caustic::Caustics,
    ellipsoid::{Patches, Window},
    emitter::Emitters,
    lobe::Mirrors,
    pool::{self, Pool},
    rng::Rng,
    world::{Hit, World, lift},
};

/// What paths are traced in.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Walk<'a> {
    pub world: &'a World,
    pub emitters: &'a Emitters,
    pub mirrors: &'a Mirrors,
    pub gate: &'a Gate,
    /// Longest path in bounces.
    pub max_bounces: u32,
    /// Walks connect to light vertices.
    pub lights: bool,
    /// Light paths by way of near-mirrors, where they pay.
    pub caustics: Option<&'a Caustics>,
    /// Shortest path from the laser to a spot, metres.
    pub shortest_m: f64,
    /// With a narrow gate: the path lengths that count; whatever else is found is not looked at.
    pub window: Option<Window>,
    /// With a narrow gate: where shared vertices are drawn for it.
    pub patches: Option<&'a Patches>,
}

/// A vertex of a path from the camera.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Vertex {
    pub hit: Hit,
    /// Unit direction back along the path.
    pub wo: Vec3,
    /// Product of scattering and sampling weights up to here.
    pub beta: f32,
    /// Optical path from where the walk is counted, metres.
    pub length_m: f64,
    /// Bounces up to and with this vertex.
    pub bounce: u32,
    /// The vertex before it is a near-mirror's.
    pub after_mirror: bool,
    /// [`Vertex::open`] of the vertex before it.
    pub open_before: bool,
}

impl Vertex {
    /// True where light paths ([`crate::caustic`]) reach the last vertex up to here that is not a
    /// near-mirror's: it is what the camera sees directly, or such a vertex comes before it too.
    #[inline]
    pub fn open(&self) -> bool {
        if self.hit.surface.specular {
            self.open_before
        } else {
            !self.after_mirror
        }
    }
}

/// How a vertex was reached, for MIS.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step {
    p: Vec3,
    n: Vec3,
    /// Density per steradian of the direction taken.
    pdf: f32,
    /// Expected number of aims at `p`.
    aims: f32,
}

/// Kinds of light vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Lights {
    /// All that spots light directly.
    All,
    /// The glossy ones among those, for vertices that a tile's shared vertices serve as well.
    Glossy,
    /// Those beyond near-mirrors.
    Beyond,
}

/// Takes what a walk finds: optical path in metres, value, spot, bounces of the whole path.
pub(crate) trait Sink {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32);
}

/// Buffers of one thread's walks.
#[derive(Debug)]
pub(crate) struct Scratch {
    pub stack: Stack,
    /// Weights of spots.
    pub weights: Vec<f32>,
    /// Weights of spots in mirrors.
    images: Vec<f32>,
    /// Weights of light vertices.
    lights: Vec<f32>,
    /// Light vertices that walks connect to.
    pub pool: Pool,
    /// Light vertices beyond near-mirrors.
    pub caustics: Pool,
}

impl Scratch {
    pub fn new(world: &World, emitters: &Emitters, mirrors: &Mirrors) -> Self {
        Self {
            stack: world.bvh.stack(),
            weights: vec![0.0; emitters.list.len()],
            images: vec![0.0; mirrors.choices()],
            lights: vec![],
            pool: Pool::default(),
            caustics: Pool::default(),
        }
    }
}

/// Spots that a camera vertex is connected to at most. This and the numbers below were chosen by
/// error² × CPU time on the reference rooms, where the optimum is flat (2, 4 and 12 spots: 7.2, 5.7 and
/// 6.0 on room-diffuse). More connections from one vertex also tie neighbouring bins of a pixel together,
/// so that errors of sums over bins exceed what the bins' own errors say.
const SPOTS: u32 = 4;
/// Connect to every spot.
pub(crate) const ALL: u32 = u32::MAX;
/// Light vertices that a camera vertex is connected to at most.
const LIGHTS: u32 = 2;
/// How often a vertex of a walk aims at images: it matters less than a gather point, and costs as much.
const AIMS: f32 = 0.25;
/// Russian roulette keeps a path with this multiple of its throughput as probability.
const SURVIVAL: f32 = 1.5;

impl Walk<'_> {
    /// True where a path with one more vertex and a spot can still count.
    #[inline]
    pub fn goes_on(&self, v: &Vertex) -> bool {
        v.hit.surface.strength > 0.0
            && v.bounce + 2 <= self.max_bounces
            && v.length_m + self.shortest_m < self.gate.end_m()
            && self.in_time(v.hit.p, v.length_m)
    }

    /// False where a narrow gate ends before the shortest path by way of `p`.
    #[inline]
    pub fn in_time(&self, p: Vec3, length_m: f64) -> bool {
        self.window
            .is_none_or(|w| length_m + self.emitters.shortest_m(self.world, p) < w.end_m)
    }

    /// Drops the weights of spots whose path by way of a surface point misses a narrow gate. Returns
    /// whether any is left.
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

    /// Whether a path from one of the spots with a weight by way of a surface point can count.
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

    /// Settles a surface of several lobes on one of them. Every vertex of a path is settled where it is
    /// found, so that each path is of one kind: by way of a mirror's lobe, or of a Lambertian one.
    #[inline]
    pub fn choose_lobe(&self, rng: &mut Rng, hit: &mut Hit) {
        if hit.surface.base > 0.0 {
            hit.surface = hit.surface.lobe(rng.uniform());
        }
    }

    /// Walks on from a vertex: everything beyond it except its own connection to the spots.
    pub fn run(&self, rng: &mut Rng, from: Vertex, scratch: &mut Scratch, sink: &mut impl Sink) {
        let mut vertex = from;
        while self.goes_on(&vertex) {
            let helped = !vertex.hit.surface.specular;
            let mut aims = 0.0;
            if helped {
                aims = self.aim(rng, &vertex, AIMS, scratch, sink);
                self.light(rng, &vertex, Lights::All, LIGHTS, scratch, sink);
                self.light(rng, &vertex, Lights::Beyond, LIGHTS, scratch, sink);
            }
            let Some((step, next)) = self.step(rng, &vertex, aims, true, &mut scratch.stack) else {
                return;
            };
            vertex = next;
            self.connect(rng, &vertex, helped.then_some(&step), SPOTS, scratch, sink);
        }
    }

    /// One step by the surface's own scattering, with Russian roulette where asked for.
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
        self.choose_lobe(rng, &mut next.hit);
        Some((step, next))
    }

    /// One step in a given direction: (direction, f·cos/pdf, pdf per steradian).
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
            beta: v.beta * weight,
            length_m: v.length_m + self.world.metres((hit.p - h.p).length()),
            bounce: v.bounce + 1,
            after_mirror: h.surface.specular,
            open_before: v.open(),
        };
        Some((step, next))
    }

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
        if h.surface.strength == 0.0 {
            return;
        }
        let planar = self.mirrors.of(h.triangle).is_some() && step.is_some();
        let caustic = self.caustics.is_some() && h.surface.specular && v.open();
        if caustic && !planar {
            return;
        }
        let Scratch {
            stack,
            weights,
            images,
            ..
        } = scratch;
        self.emitters.weights(h.p, h.n, v.wo, &h.surface, weights);
        if caustic {
            for &spot in &self.emitters.glossy {
                weights[spot] = 0.0;
            }
        }
        if !self.keep_in_window(h.p, v.length_m, weights) {
            return;
        }
        if let Some(step) = step {
            self.plain_shares(step, h, weights, images);
        }
        let mut each = |spot: usize, value: f32| {
            let e = &self.emitters.list[spot];
            if self.world.free(stack, h.p, h.n, e.p, e.n) {
                let path = v.length_m + self.world.metres((e.p - h.p).length()) + e.path_m;
                sink.add(path, v.beta * value, spot, v.bounce + 1);
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
    /// sampling, against aiming (mirrors) or light vertices (other surfaces).
    fn plain_shares(&self, step: &Step, h: &Hit, weights: &mut [f32], images: &mut [f32]) {
        if h.surface.specular {
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
            // Both Lambertian: weight = strength · f · cos cos / d², and the light vertex' density is
            // share(cos / π) · cos / d².
            let light = pool::share(self.emitters, 1.0 / (PI * h.surface.strength));
            for (w, &s) in weights.iter_mut().zip(strength) {
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
                let light = pool::share(self.emitters, pdf) * h.n.dot(dir).abs() / d2;
                *w *= plain / (plain + light);
            }
        }
    }

    /// Looks for a spot's image in a planar mirror, `often` times on average (at most once). Returns that
    /// number, 0 without mirrors, for MIS.
    pub fn aim(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        often: f32,
        scratch: &mut Scratch,
        sink: &mut impl Sink,
    ) -> f32 {
        if self.mirrors.list.is_empty() {
            return 0.0;
        }
        if often == 1.0 || rng.uniform() < often {
            self.aim_once(rng, v, often, scratch, sink);
        }
        often
    }

    fn aim_once(
        &self,
        rng: &mut Rng,
        v: &Vertex,
        often: f32,
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
        // From where the ray starts, not from `h.p`: it must meet the mirror where its density is known,
        // and narrow lobes are no wider than the lift.
        let from = lift(h.p, h.n);
        let to = aim.target - from;
        let Some(m) = self.world.closest(&mut scratch.stack, from, to) else {
            return;
        };
        if self.mirrors.of(m.triangle) != Some(aim.mirror) || m.surface.strength == 0.0 {
            return;
        }
        let leg = m.p - h.p;
        let w = leg.normalized();
        let e = &self.emitters.list[aim.spot];
        let there = self
            .emitters
            .weight(aim.spot, m.p, m.n, -w, &m.surface.gloss());
        let value = h.surface.scatter(h.n, v.wo, w) * there;
        let lengths = self.world.metres(leg.length()) + self.world.metres((e.p - m.p).length());
        let path = v.length_m + lengths + e.path_m;
        let counts = value != 0.0 && self.window.is_none_or(|w| w.holds(path));
        if !counts || !self.world.free(&mut scratch.stack, m.p, m.n, e.p, e.n) {
            return;
        }
        let aimed = often * aim.chance * self.mirrors.pdf(aim.mirror, aim.spot, h.p, m.p);
        let plain = h.surface.pdf(h.n, v.wo, w);
        let value = v.beta * value / (aimed + plain);
        sink.add(path, value, aim.spot, v.bounce + 2);
    }

    /// Connects a vertex that is not a near-mirror's to `count` light vertices of some kind, drawn by
    /// unshadowed contribution.
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
            pool,
            caustics,
            ..
        } = scratch;
        let pool = match which {
            Lights::Beyond => caustics,
            _ => pool,
        };
        let wanted = match which {
            Lights::All => self.lights,
            Lights::Glossy => self.lights && pool.has_gloss(),
            Lights::Beyond => self.caustics.is_some() && !pool.list.is_empty(),
        };
        if !wanted {
            return;
        }
        if which == Lights::Glossy {
            pool.glossy_weights(h, v.wo, lights);
        } else {
            pool.weights(h, v.wo, lights);
        }
        if let Some(window) = &self.window {
            for (w, y) in lights.iter_mut().zip(&pool.list) {
                let path = v.length_m + self.world.metres((y.hit.p - h.p).length()) + y.path_m;
                *w = if window.holds(path) { *w } else { 0.0 };
            }
        }
        draw(lights, count, rng.uniform(), |i, value| {
            let y = &pool.list[i];
            let (there, bounces) = (&y.hit, v.bounce + y.bounces);
            if bounces <= self.max_bounces && self.world.free(stack, h.p, h.n, there.p, there.n) {
                let path = v.length_m + self.world.metres((there.p - h.p).length()) + y.path_m;
                sink.add(path, v.beta * value, y.spot, bounces);
            }
        });
    }
}

/// Systematic sampling: draws `count` times in proportion to `weights`, from one random number, and
/// calls `each` once for every entry drawn with its share of the sum. Unbiased for the sum.
#[inline]
fn draw(weights: &[f32], count: u32, u: f32, mut each: impl FnMut(usize, f32)) {
    let total: f32 = weights.iter().sum();
    // Beneath the least normal number a step could be 0.
    if !(total > 1e-30 && total.is_finite()) {
        return;
    }
    let step = total / count as f32;
    let (mut sum, mut next) = (0.0, u * step);
    for (i, &w) in weights.iter().enumerate() {
        sum += w;
        let mut times = 0;
        while next < sum {
            times += 1;
            next += step;
        }
        if times > 0 {
            each(i, times as f32 * step);
        }
    }
}
