//! A path at one of its surface points.

use picofarm_scene::Vec3;

use crate::{
    numeric::rng::Rng,
    paths::glass::{aim::Aim, ray::Ray},
    scene::{hit::Hit, intersection::lift},
};

/// Factor from a path's weight to the probability that a camera path continues, and the largest
/// probability.
const STAY: f32 = 1.5;
const MOST_STAY: f32 = 0.95;

/// The state of a path.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Carried {
    /// The remaining radiance or flux.
    pub weight: f32,
    /// Optical path, metres.
    pub length_m: f64,
    pub bounces: u32,
}

/// A path at one of its surface points.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point {
    pub hit: Hit,
    /// Unit direction back along the path.
    pub back: Vec3,
    /// The path up to here, including the bounce here.
    pub path: Carried,
    /// Index of refraction of the medium around the point.
    pub medium: f32,
    /// Number of turns by glass on the leg that led here.
    pub turns: u32,
    /// Whether that leg was turned once, by a pane in which points have images; and by one in which
    /// spots are points of light.
    pub imaged: bool,
    pub shows: bool,
}

impl Point {
    /// Flux goes on by the surface's scattering: what the path carries then, and the ray. `survive`
    /// says with which chance a step of a weight does.
    pub fn scatter(&self, survive: impl Fn(f32) -> f32, rng: &mut Rng) -> Option<(Carried, Ray)> {
        let h = &self.hit;
        let (w, weight, _) = h.surface.sample(h.n, self.back, rng)?;
        let chance = survive(weight);
        if chance < 1.0 && rng.uniform() >= chance {
            return None;
        }
        Some(self.onward((w, weight / chance), false))
    }

    /// Radiance goes on by the surface's scattering or to where glass is. What the path carries
    /// then, the ray, and what is left of `left`: what it would carry by scattering alone, since
    /// how narrow the cones are says nothing of what lies in them. Roulette goes by that.
    pub fn seek(&self, aim: &Aim, left: f32, rng: &mut Rng) -> Option<(Carried, Ray, f32)> {
        let h = &self.hit;
        let (w, weight, own) = match aim.from(h) {
            Some(cones) => cones.sample(h, self.back, rng)?,
            None => {
                let (w, weight, _) = h.surface.sample(h.n, self.back, rng)?;
                (w, weight, weight)
            }
        };
        let chance = (STAY * left * own).min(MOST_STAY);
        if rng.uniform() >= chance {
            return None;
        }
        let (path, ray) = self.onward((w, weight / chance), true);
        Some((path, ray, left * own / chance))
    }

    pub fn onward(&self, (w, weight): (Vec3, f32), radiance: bool) -> (Carried, Ray) {
        let h = &self.hit;
        let path = Carried {
            weight: self.path.weight * weight,
            ..self.path
        };
        let from = lift(h.p, h.n);
        (path, Ray::new(h.p, from, w, (self.medium, radiance)))
    }
}
