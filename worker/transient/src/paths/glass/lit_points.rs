//! Points that scatter light on its way to a pane, with all the light that they scatter: the light
//! from every spot, and the light that a walk from them samples. Their mirror images are connected
//! to camera paths, so that a single path via a pane carries many arrivals, and no arrival is
//! rare.
//!
//! The points are on Lambertian surfaces. Half of them are drawn by the scattering of the spots,
//! half uniformly over all surfaces, combined by the balance heuristic. No other technique samples
//! paths via an image of such a point that continue by straight legs alone to a spot.

use picofarm_scene::Vec3;

use crate::{
    api::Stop,
    film::{
        class::{Place, Way},
        sink::Sink,
    },
    numeric::rng::Rng,
    paths::{
        path_reuse::sharing::Sharing,
        scratch::Scratch,
        tracer::Walk,
        vertex::{Sight, Vertex},
    },
    scene::{hit::Hit, intersection::lift, lobes::Seen, stratified::Turns, world::World},
};

/// Largest number of points, and the number of light vertices that their walks are connected to.
const POINTS: u32 = 128;
const LIGHT_VERTICES: u32 = 64;

/// Light that arrives at a point and is scattered there.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Arrival {
    /// Optical path from the laser, metres.
    pub path_m: f64,
    /// Radiance that it leaves with, over the density of the point.
    pub value: f32,
    /// Emitter.
    pub spot: usize,
    /// Number of bounces up to and including the point.
    pub bounces: u32,
}

/// A surface point lit by spots.
#[derive(Debug)]
pub(crate) struct LitPoint {
    pub hit: Hit,
    pub arrivals: Vec<Arrival>,
    /// Sum of the arrivals' light.
    pub sum: f32,
}

/// The lit points of one stream.
#[derive(Debug, Default)]
pub(crate) struct Lit {
    pub list: Vec<LitPoint>,
}

/// Running sums of the area of all surfaces; triangles that scatter no light do not count.
#[derive(Debug, Default)]
pub(crate) struct Areas(Vec<f64>);

impl Areas {
    pub fn of(world: &World, stop: Stop) -> Self {
        let mut sum = 0.0;
        let each = world.triangles.iter().enumerate().map(|(k, [a, b, c])| {
            let surface = &world.surfaces[world.surface[k] as usize];
            let stopped = k % 65536 == 0 && stop.asked();
            if world.normals[k] != Vec3::ZERO && !surface.is_black() && !stopped && world.counts(k)
            {
                sum += f64::from(0.5 * (*b - *a).cross(*c - *a).length());
            }
            sum
        });
        Self(each.collect())
    }

    /// Returns the total area, render units squared.
    pub fn whole(&self) -> f64 {
        self.0.last().copied().unwrap_or(0.0)
    }

    /// Draws a point of a surface, on one of its sides.
    fn draw(&self, world: &World, at: f64, rng: &mut Rng) -> Option<Hit> {
        let at = at * self.whole();
        let k = self.0.partition_point(|&s| s <= at);
        let [a, b, c] = *world.triangles.get(k)?;
        let (r, v) = (rng.uniform().sqrt(), rng.uniform());
        let p = a * (1.0 - r) + b * (r * (1.0 - v)) + c * (r * v);
        let n = world.normals[k];
        let side = if rng.uniform() < 0.5 { n } else { -n };
        Some(world.on(k as u32, p, p + side))
    }
}

/// The sink for the light that a walk samples beyond a point.
struct Arrivals<'a>(&'a mut Vec<Arrival>);

impl Sink for Arrivals<'_> {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, _: Way) {
        self.0.push(Arrival {
            path_m,
            value,
            spot,
            bounces,
        });
    }

    fn at(&mut self, _: Place) {}
}

impl Lit {
    /// Returns whether a point may be a lit point: it is on a Lambertian surface, and not near a
    /// spot with a zone.
    pub fn may_hold(walk: &Walk, hit: &Hit) -> bool {
        let near = walk.contacts.is_some_and(|c| c.near(walk.world, hit));
        hit.surface.diffuse() && !hit.surface.is_black() && !near
    }

    /// Draws the light vertices that walks are connected to.
    pub fn prepare(walk: &Walk, rng: &mut Rng, scratch: &mut Scratch) {
        Sharing::draw_lights(walk, POINTS, rng, scratch);
        if walk.lights {
            let of = (walk.world, walk.emitters, walk.contacts);
            let Scratch {
                vertices, stack, ..
            } = scratch;
            vertices.fill(of, LIGHT_VERTICES, rng, stack);
        }
    }

    /// Redraws the points.
    pub fn lay(&mut self, (walk, areas): (&Walk, &Areas), rng: &mut Rng, scratch: &mut Scratch) {
        let (world, emitters) = (walk.world, walk.emitters);
        let spots = emitters.list.len();
        self.list.clear();
        let walk = Walk {
            window: None,
            ..*walk
        };
        let half = POINTS / 2;
        let turns = Turns::new(half, rng);
        for j in 0..POINTS {
            let hit = if j < half {
                let e = &emitters.list[turns.choice(j, spots)];
                let drawn = turns.direction(j, &e.surface, e.n, e.back, rng);
                drawn.and_then(|(w, ..)| world.closest(&mut scratch.stack, lift(e.p, e.n), w))
            } else {
                let at = (f64::from(j - half) + f64::from(rng.uniform())) / f64::from(half);
                areas.draw(world, at, rng)
            };
            let Some(hit) = hit else { continue };
            if Self::may_hold(&walk, &hit) {
                let even = 0.5 * f64::from(half) / areas.whole();
                let density = (half as f32 / spots as f32, even as f32);
                self.list
                    .extend(LitPoint::new(&walk, hit, density, rng, scratch));
            }
        }
    }
}

impl LitPoint {
    /// Creates a point that was drawn with the sum of two densities per area: `by_spot` times each
    /// spot's own, and `even`.
    fn new(
        walk: &Walk,
        hit: Hit,
        (by_spot, even): (f32, f32),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) -> Option<Self> {
        let (world, emitters) = (walk.world, walk.emitters);
        let mut arrivals = vec![];
        let Scratch {
            stack,
            weights,
            plain,
            ..
        } = &mut *scratch;
        emitters.weights((Seen::of(&hit, hit.n), &hit.surface), plain, weights);
        let mut density = even;
        for (spot, (e, &weight)) in emitters.list.iter().zip(weights.iter()).enumerate() {
            let to = hit.p - e.p;
            let d2 = to.dot(to);
            let w = to / d2.sqrt();
            let pdf = e.surface.pdf(e.n, e.back, w);
            if !(pdf > 0.0 || weight > 0.0) {
                continue;
            }
            let free = world.free(stack, hit.p, hit.n, e.p, e.n);
            if free > 0.0 {
                density += by_spot * pdf * hit.n.dot(w).abs() / d2;
            }
            if free * weight > 0.0 {
                arrivals.push(Arrival {
                    path_m: world.metres(d2.sqrt()) + e.path_m,
                    value: weight * free,
                    spot,
                    bounces: 2,
                });
            }
        }
        let vertex = Vertex {
            hit,
            wo: hit.n,
            beta: 1.0,
            length_m: 0.0,
            bounce: 1,
            sight: Sight::ELSEWHERE,
        };
        let on = (vertex, crate::paths::tracer::SPOTS);
        walk.run(rng, on, scratch, &mut Arrivals(&mut arrivals));
        for a in &mut arrivals {
            a.value /= density;
        }
        let sum: f32 = arrivals.iter().map(|a| a.value).sum();
        (sum > 0.0 && sum.is_finite()).then_some(Self { hit, arrivals, sum })
    }
}
