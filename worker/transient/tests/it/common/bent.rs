//! Light that the camera sees by reflection and refraction at glass, traced from the camera's side:
//! paths with a bent leg at the camera ([`super::light::Bends`]).
//!
//! They are connected to spots by a straight leg. If the leg at the spot is bent too, they are
//! connected to vertices of light paths. If no leg is straight, a camera path and a light path are
//! joined if their ends are closer than [`MEET`].

use std::f64::consts::PI;

use super::{
    brute::{Noise, P, f},
    glass::Draw,
    light::{Arrival, Bends, LONGEST, Source, Tracer, scatter},
    seen::Films,
    tree::Vertex,
};

/// The straight leg that connects a path with bent legs at both ends. Each choice gives the same
/// energy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Connects {
    /// The straight leg nearest to the spot: all earlier legs of the light path are bent.
    NearestToSpot,
    /// The straight leg nearest to the camera.
    NearestToCamera,
}

/// The maximum distance between the ends of a camera path and of a light path, metres, if no leg is
/// straight.
const MEET: f64 = 0.03;

/// The bent legs of a path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Ends {
    /// The leg at the camera, and not the one at the spot.
    Camera,
    /// Both end legs, but not all legs.
    Both,
    /// All legs.
    All,
}

/// The contribution of a camera path.
#[derive(Debug, Clone, Copy)]
pub struct Found {
    pub pixel: usize,
    /// Three bounces and more.
    pub more: bool,
    pub ends: Ends,
    /// Contribution to the mean.
    pub value: f64,
}

/// Returns the radiance towards `back` from the flux of a light path that ends nearby, spread over
/// a disc.
fn meeting(x: &Vertex, back: P, a: &Arrival) -> f64 {
    let to = a.at.p - x.p;
    let near = to.length() < MEET && to.dot(x.n).abs() < 1e-2 && x.n.dot(a.at.n) > 0.9;
    match near {
        true => a.flux * f(a.at.bsdf, a.at.n, a.back, back) / (PI * MEET * MEET),
        false => 0.0,
    }
}

impl Tracer {
    /// Returns vertices of `paths` light paths, bent in their first leg, to connect camera paths
    /// to.
    pub fn lights(
        &self,
        sources: &[Source],
        paths: usize,
        connects: Connects,
        rng: &mut Noise,
    ) -> Vec<Arrival> {
        let mut all = vec![];
        for s in sources {
            let many = (paths / sources.len(), LONGEST);
            self.arrivals(s, many, Draw::LIGHT.bending(), rng, |a| {
                let on = match connects {
                    Connects::NearestToSpot => !a.bends.straight,
                    Connects::NearestToCamera => a.bends.first,
                };
                if on {
                    all.push(*a);
                }
                on
            });
        }
        all
    }

    /// Traces `samples` camera paths that are bent in their first leg, nine in ten through the
    /// pixels of `likely`. `lights` are the result of [`Tracer::lights`] for the same connection.
    pub fn past_glass(
        &self,
        (sources, lights, connects): (&[Source], &[Arrival], Connects),
        likely: &[usize],
        samples: usize,
        rng: &mut Noise,
        mut add: impl FnMut(Found),
    ) {
        let films = Films::new(self, likely);
        for sample in 0..samples {
            let (film, mut beta) = films.draw(sample, samples, rng);
            let mut draw = Draw::CAMERA.bending();
            let (mut from, mut index, mut bounces) = ((self.origin(), self.ray(film)), 1.0, 0);
            let mut bends = Bends::default();
            while bounces < LONGEST {
                let Some(leg) = self.leg(from, index, draw, rng) else {
                    break;
                };
                bends = bends.and(leg.bent);
                if !bends.first {
                    break;
                }
                (index, draw) = (leg.index, Draw::CAMERA);
                beta *= leg.weight;
                bounces += 1 + leg.reflections;
                let (at, back) = (leg.end, leg.d * -1.0);
                let mut found = |bounces: u32, ends, value: f64| {
                    if value > 0.0 {
                        add(Found {
                            pixel: self.pixel(film),
                            more: bounces > 2,
                            ends,
                            value,
                        });
                    }
                };
                if bounces == 1 + leg.reflections && connects == Connects::NearestToSpot {
                    let spots = sources.iter().map(Arrival::at_spot);
                    for a in spots.chain(lights.iter().copied()) {
                        let all = bounces - 1 + a.bounces;
                        if all >= 2 {
                            found(all, Ends::All, beta * meeting(&at, back, &a));
                        }
                    }
                }
                for s in sources {
                    found(bounces + 1, Ends::Camera, beta * self.lit(&at, back, s));
                }
                if connects == Connects::NearestToSpot || !bends.straight {
                    // The path has three vertices at least.
                    found(3, Ends::Both, beta * self.joined(&at, back, lights, rng));
                }
                let pair = [rng.next(), rng.next()];
                let Some((w, weight)) = scatter(&at, back, pair) else {
                    break;
                };
                beta *= weight;
                if bounces > 7 {
                    if rng.next() > 0.7 {
                        break;
                    }
                    beta /= 0.7;
                }
                from = (at.p, w);
            }
        }
    }

    /// Returns the radiance towards `back` from light that arrives straight from the vertices of
    /// light paths. One of them is drawn by its unoccluded contribution, so that pairs that nearly
    /// touch contribute no more than others.
    fn joined(&self, x: &Vertex, back: P, lights: &[Arrival], rng: &mut Noise) -> f64 {
        let brings = |a: &Arrival| {
            let to = a.at.p - x.p;
            let d2 = to.dot(to);
            let w = to * (1.0 / d2.sqrt());
            let (c, l) = (x.n.dot(w), -a.at.n.dot(w));
            if !(c > 0.0 && l > 0.0) {
                return 0.0;
            }
            let there = a.flux * f(a.at.bsdf, a.at.n, a.back, w * -1.0);
            f(x.bsdf, x.n, back, w) * c * l * there / d2
        };
        let sums: Vec<f64> = lights
            .iter()
            .scan(0.0, |sum, a| {
                *sum += brings(a);
                Some(*sum)
            })
            .collect();
        let whole = sums.last().copied().unwrap_or(0.0);
        if whole <= 0.0 {
            return 0.0;
        }
        let at = whole * rng.next();
        let one = sums.partition_point(|s| *s <= at).min(sums.len() - 1);
        let p = lights[one].at.p;
        match self.tree.free(x.p, p) {
            true => whole * self.tree.through(x.p, p),
            false => 0.0,
        }
    }
}
