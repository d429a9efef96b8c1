//! Scattering for two directions on the same side of a facet: Lambertian, rough conductor (Beckmann
//! or GGX; Walter et al., EGSR 2007) and a mix of both.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    numeric::{exponential::exp_minus, frame::frame, rng::Rng},
    scene::{
        beckmann,
        lobe::{Lobe, beckmann_masking},
        surface::{Kind, Surface},
    },
};

impl Surface {
    /// Returns f · cos(n, o) for unit directions `i` and `o`, both leaving the surface.
    #[inline(always)]
    pub fn scatter(&self, n: Vec3, i: Vec3, o: Vec3) -> f32 {
        let (ci, co) = (n.dot(i), n.dot(o));
        if !(ci > 0.0 && co > 0.0) || self.is_black() {
            return 0.0;
        }
        if self.diffuse() {
            return self.strength * co;
        }
        self.scatter_rough(n, i, o, (ci, co))
    }

    /// Like [`Surface::scatter`], for surfaces that are not Lambertian, given the cosines of both
    /// directions.
    #[inline]
    pub fn scatter_rough(&self, n: Vec3, i: Vec3, o: Vec3, (ci, co): (f32, f32)) -> f32 {
        let d = self.density(n, i + o);
        if d == 0.0 {
            return self.base * co;
        }
        self.strength * d * self.masking(ci) * self.masking(co) / (4.0 * ci) + self.base * co
    }

    /// Returns the lobe for light from a direction with cosine `c`, for evaluation in many
    /// directions at once; black for directions below the surface.
    #[inline]
    pub fn lobe_from(&self, c: f32) -> Lobe {
        let lit = c > 0.0 && !self.is_black();
        let alpha2 = self.alpha * self.alpha;
        match self.kind {
            _ if !lit => Lobe::BLACK,
            Kind::Lambertian => Lobe {
                lambertian: self.strength,
                lambertian_pdf: 1.0 / PI,
                ..Lobe::BLACK
            },
            Kind::Conductor | Kind::Mixed => {
                let share = if self.is_mixed() { self.share() } else { 1.0 };
                let (leaving, turn) = (self.leaving(c), 1.0 / (4.0 * PI * alpha2));
                let seen = match self.ggx() {
                    true => leaving,
                    false => self.seen(c),
                };
                Lobe {
                    conductor: self.strength * leaving * turn,
                    lambertian: self.base,
                    alpha2,
                    conductor_pdf: share * seen * turn,
                    lambertian_pdf: (1.0 - share) / PI,
                    beckmann: if self.ggx() { 0.0 } else { 1.0 },
                }
            }
        }
    }

    /// Returns two numbers (a, b) for the BRDF of a non-Lambertian surface, from a
    /// direction with cosine `c` to another. The BRDF is a + b times [`Surface::leaving`] and
    /// [`Surface::lobe_ggx`] or [`Surface::lobe_beckmann`] of the other direction.
    pub fn arriving(&self, c: f32) -> (f32, f32) {
        let a2 = self.alpha * self.alpha;
        (self.base, self.strength * self.leaving(c) / (4.0 * PI * a2))
    }

    /// Returns G₁ over the cosine `c`, above the surface; see [`Surface::arriving`].
    pub fn leaving(&self, c: f32) -> f32 {
        let leaving = match self.ggx() {
            true => 2.0 / self.edge(c),
            false => self.masking(c) / c,
        };
        if leaving.is_finite() { leaving } else { 0.0 }
    }

    /// Returns G₁ over the cosine `c` for the sampling of visible facets. It is Smith's for both
    /// distributions, to the last digits, because the samples follow it.
    #[inline]
    pub fn seen(&self, c: f32) -> f32 {
        match self.ggx() {
            true => self.leaving(c),
            false => beckmann::seen(self.alpha, c),
        }
    }

    /// Returns D·π·α² of GGX from the square of the sum of both directions and the square of its
    /// part along the normal; see [`Surface::arriving`]. It is valid for lobes wide enough that
    /// their difference does not cancel.
    #[inline(always)]
    pub fn lobe_ggx(&self, square: f32, along2: f32) -> f32 {
        let (across2, a2) = ((square - along2).max(0.0), self.alpha * self.alpha);
        let t = square * a2 / (along2 * a2 + across2 + f32::MIN_POSITIVE);
        t * t
    }

    /// Like [`Surface::lobe_ggx`], for Beckmann.
    #[inline(always)]
    pub fn lobe_beckmann(&self, square: f32, along2: f32) -> f32 {
        let across2 = (square - along2).max(0.0);
        let x = across2 / (along2 * self.alpha * self.alpha);
        let cos2 = along2 / square;
        let lobe = exp_minus(x) / (cos2 * cos2);
        if lobe > 0.0 { lobe } else { 0.0 }
    }

    /// Draws a direction for `i`: (direction, f·cos/pdf, pdf per steradian); `None` where none
    /// leaves.
    #[inline]
    pub fn sample(&self, n: Vec3, i: Vec3, rng: &mut Rng) -> Option<(Vec3, f32, f32)> {
        if self.diffuse() {
            let (o, c) = cosine(n, rng)?;
            return Some((o, self.strength * PI, c / PI));
        }
        if !self.is_mixed() {
            return self.sample_conductor(n, i, rng);
        }
        let o = if rng.uniform() < self.share() {
            self.sample_conductor(n, i, rng)?.0
        } else {
            cosine(n, rng)?.0
        };
        let pdf = self.pdf(n, i, o);
        (pdf > 0.0).then(|| (o, self.scatter(n, i, o) / pdf, pdf))
    }

    #[inline]
    pub fn sample_conductor(&self, n: Vec3, i: Vec3, rng: &mut Rng) -> Option<(Vec3, f32, f32)> {
        let (t, b) = frame(n);
        let ci = n.dot(i);
        // From below the surface no facet is visible, and drawing one would never end.
        if ci <= 0.0 || ci.is_nan() {
            return None;
        }
        let seen_from = [t.dot(i), b.dot(i), ci];
        let h = match self.ggx() {
            true => visible_ggx(self.alpha, seen_from, rng),
            false => beckmann::visible(self.alpha, seen_from, rng),
        };
        let h = (t * h[0] + b * h[1] + n * h[2]).normalized();
        let ih = i.dot(h);
        if ih <= 0.0 {
            return None;
        }
        let o = (h * (2.0 * ih) - i).normalized();
        let co = n.dot(o);
        if co <= 0.0 || co.is_nan() {
            return None;
        }
        let seen = self.seen(ci);
        // 1 except for the error of Walter's approximation.
        let approximated = match self.ggx() {
            true => 1.0,
            false => self.leaving(ci) / seen,
        };
        let weight = self.strength * approximated * self.masking(co);
        Some((o, weight, 0.25 * seen * self.density(n, i + o)))
    }

    /// Returns the density per steradian with which [`Surface::sample`] draws `o`.
    #[inline]
    pub fn pdf(&self, n: Vec3, i: Vec3, o: Vec3) -> f32 {
        let (ci, co) = (n.dot(i), n.dot(o));
        if !(co > 0.0 && ci > 0.0) {
            return 0.0;
        }
        if self.diffuse() {
            return co / PI;
        }
        let conductor = 0.25 * self.seen(ci) * self.density(n, i + o);
        if !self.is_mixed() {
            return conductor;
        }
        let share = self.share();
        share * conductor + (1.0 - share) * co / PI
    }

    /// Returns D(h) for h along `sum` = i + o. The slope is computed from n × h, because 1 − cos²
    /// would cancel at small α.
    #[inline]
    pub fn density(&self, n: Vec3, sum: Vec3) -> f32 {
        let (c, s) = (n.dot(sum), n.cross(sum));
        let (c2, s2) = (c * c, s.dot(s));
        let a2 = self.alpha * self.alpha;
        if self.ggx() {
            let r = 1.0 / (c2 + s2);
            let spread = (c2 + s2 / a2) * r;
            return if c > 0.0 {
                1.0 / (PI * a2 * spread * spread)
            } else {
                0.0
            };
        }
        let x = s2 / (c2 * a2);
        let e = exp_minus(x);
        if c <= 0.0 || e == 0.0 {
            return 0.0;
        }
        let cos2 = c2 / (c2 + s2);
        e / (PI * a2 * cos2 * cos2)
    }

    /// Returns G₁: Smith's for GGX, Walter's rational approximation for Beckmann.
    #[inline]
    pub fn masking(&self, c: f32) -> f32 {
        if self.ggx() {
            return 2.0 * c / self.edge(c);
        }
        let tan = (1.0 - c * c).max(0.0).sqrt() / c;
        beckmann_masking(1.0 / (self.alpha * tan))
    }

    /// Returns 2cos / G₁ of GGX.
    #[inline(always)]
    pub fn edge(&self, c: f32) -> f32 {
        let c2 = c * c;
        c + (c2 + self.alpha * self.alpha * (1.0 - c2).max(0.0)).sqrt()
    }
}

/// Returns a cosine-distributed direction around `n`, and its cosine.
#[inline]
fn cosine(n: Vec3, rng: &mut Rng) -> Option<(Vec3, f32)> {
    let (t, b) = frame(n);
    let (x, y, r2) = rng.disc();
    let z = (1.0 - r2).sqrt();
    let o = (t * x + b * y + n * z).normalized();
    let c = n.dot(o);
    (c > 0.0).then_some((o, c))
}

/// Returns a half vector of GGX among those visible from `i`, in the surface's frame and of any
/// length (Heitz, JCGT 2018). Its weights never exceed 1, however rough or grazing.
#[inline]
fn visible_ggx(alpha: f32, i: [f32; 3], rng: &mut Rng) -> [f32; 3] {
    let v = Vec3::new(alpha * i[0], alpha * i[1], i[2]).normalized();
    let flat = v.x * v.x + v.y * v.y;
    let t = if flat > 0.0 {
        Vec3::new(-v.y, v.x, 0.0) / flat.sqrt()
    } else {
        Vec3::new(1.0, 0.0, 0.0)
    };
    let b = v.cross(t);
    let (x, y, _) = rng.disc();
    let s = 0.5 * (1.0 + v.z);
    let y = (1.0 - s) * (1.0 - x * x).max(0.0).sqrt() + s * y;
    let h = t * x + b * y + v * (1.0 - x * x - y * y).max(0.0).sqrt();
    [alpha * h.x, alpha * h.y, h.z.max(0.0)]
}

#[cfg(test)]
#[path = "bsdf/tests.rs"]
mod tests;
