//! A path at one of its surface points.

use picofarm_scene::Vec3;

use crate::{
    numeric::rng::Rng,
    paths::glass::{aim::AimSpheres, ray::Ray},
    scene::{hit::Hit, intersection::lift, surface::ScatterSample},
    tuning::GlassTuning,
};

/// The state of a path.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PathState {
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
    pub path: PathState,
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
    /// Continues a path of flux by the surface's scattering. Returns its new state and the ray.
    /// `survive` gives the probability that a step of a weight survives.
    pub fn scatter(&self, survive: impl Fn(f32) -> f32, rng: &mut Rng) -> Option<(PathState, Ray)> {
        let h = &self.hit;
        let ScatterSample { w, weight, .. } = h.surface.sample(h.n, self.back, rng)?;
        let chance = survive(weight);
        if chance < 1.0 && rng.uniform() >= chance {
            return None;
        }
        Some(self.onward((w, weight / chance), false))
    }

    /// Continues a path of radiance by the surface's scattering or towards glass. Returns its new
    /// state, the ray, and the new `left`: the remaining weight by scattering alone. Russian
    /// roulette uses it, because the width of the cones does not depend on the light within them.
    pub fn seek(
        &self,
        aim: &AimSpheres,
        tuning: &GlassTuning,
        left: f32,
        rng: &mut Rng,
    ) -> Option<(PathState, Ray, f32)> {
        let h = &self.hit;
        let (w, weight, own) = match aim.from(h) {
            Some(cones) => cones.sample(h, self.back, rng)?,
            None => {
                let ScatterSample { w, weight, .. } = h.surface.sample(h.n, self.back, rng)?;
                (w, weight, weight)
            }
        };
        let chance = (tuning.survival * left * own).min(tuning.most_survival);
        if rng.uniform() >= chance {
            return None;
        }
        let (path, ray) = self.onward((w, weight / chance), true);
        Some((path, ray, left * own / chance))
    }

    pub fn onward(&self, (w, weight): (Vec3, f32), radiance: bool) -> (PathState, Ray) {
        let h = &self.hit;
        let path = PathState {
            weight: self.path.weight * weight,
            ..self.path
        };
        let from = lift(h.p, h.n);
        (path, Ray::new(h.p, from, w, (self.medium, radiance)))
    }
}
