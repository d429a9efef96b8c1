//! Scattering: Lambertian and Beckmann rough conductor (Walter et al., EGSR 2007), for two directions on
//! the same side of a facet.

use std::f32::consts::PI;

use picofarm_scene::{Bsdf, Material, Vec3};

use crate::rng::Rng;

/// A material's scattering, ready for use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    /// Lambertian: ρ/π. Conductor: its reflectance. 0 = black.
    pub strength: f32,
    /// Roughness; 0 for Lambertian surfaces.
    pub alpha: f32,
    /// Scatters from both sides.
    pub two_sided: bool,
    /// Counts as a mirror (specular mask).
    pub specular: bool,
}

impl Surface {
    pub fn new(m: &Material) -> Self {
        let (strength, alpha) = match m.bsdf {
            Bsdf::Diffuse { reflectance } => (reflectance / PI, 0.0),
            Bsdf::RoughConductor {
                alpha, reflectance, ..
            } => (reflectance, alpha),
        };
        Self {
            strength,
            alpha,
            two_sided: m.two_sided,
            specular: m.is_specular(),
        }
    }

    /// The same surface, scattering nothing.
    pub fn black(self) -> Self {
        Self {
            strength: 0.0,
            ..self
        }
    }

    /// True for Lambertian surfaces.
    #[inline(always)]
    pub fn diffuse(&self) -> bool {
        self.alpha == 0.0
    }

    /// f · cos(n, o) for unit directions `i` and `o`, both leaving the surface.
    #[inline]
    pub fn scatter(&self, n: Vec3, i: Vec3, o: Vec3) -> f32 {
        let (ci, co) = (n.dot(i), n.dot(o));
        if !(ci > 0.0 && co > 0.0) || self.strength == 0.0 {
            return 0.0;
        }
        if self.diffuse() {
            return self.strength * co;
        }
        let d = self.beckmann(n, i + o);
        if d == 0.0 {
            return 0.0;
        }
        self.strength * d * self.masking(ci) * self.masking(co) / (4.0 * ci)
    }

    /// Draws a direction for `i`: (direction, f·cos/pdf, pdf per steradian); `None` where none leaves.
    #[inline]
    pub fn sample(&self, n: Vec3, i: Vec3, rng: &mut Rng) -> Option<(Vec3, f32, f32)> {
        let (t, b) = frame(n);
        if self.diffuse() {
            let (x, y, r2) = rng.disc();
            let z = (1.0 - r2).sqrt();
            let o = (t * x + b * y + n * z).normalized();
            let c = n.dot(o);
            return (c > 0.0).then_some((o, self.strength * PI, c / PI));
        }
        let (x, y) = rng.circle();
        let slope = self.alpha * (-libm::logf(1.0 - rng.uniform())).sqrt();
        let h = (t * (slope * x) + b * (slope * y) + n).normalized();
        let ih = i.dot(h);
        if ih <= 0.0 {
            return None;
        }
        let o = (h * (2.0 * ih) - i).normalized();
        let (ci, co, ch) = (n.dot(i), n.dot(o), n.dot(h));
        if !(ci > 0.0 && co > 0.0) {
            return None;
        }
        let weight = self.strength * self.masking(ci) * self.masking(co) * ih / (ci * ch);
        Some((o, weight, self.beckmann(n, i + o) * ch / (4.0 * ih)))
    }

    /// Density per steradian with which [`Surface::sample`] draws `o`.
    #[inline]
    pub fn pdf(&self, n: Vec3, i: Vec3, o: Vec3) -> f32 {
        let co = n.dot(o);
        if !(co > 0.0 && n.dot(i) > 0.0) {
            return 0.0;
        }
        if self.diffuse() {
            return co / PI;
        }
        let h = (i + o).normalized();
        self.beckmann(n, i + o) * n.dot(h) / (4.0 * i.dot(h))
    }

    /// D(h) for h along `sum` = i + o. The slope comes from n × h: 1 − cos² would cancel at small α.
    #[inline]
    fn beckmann(&self, n: Vec3, sum: Vec3) -> f32 {
        let (c, s) = (n.dot(sum), n.cross(sum));
        let (c2, s2) = (c * c, s.dot(s));
        let a2 = self.alpha * self.alpha;
        let x = s2 / (c2 * a2);
        // e^-80 is beneath everything that f32 can add to anything.
        if c <= 0.0 || x > 80.0 {
            return 0.0;
        }
        let cos2 = c2 / (c2 + s2);
        libm::expf(-x) / (PI * a2 * cos2 * cos2)
    }

    /// Walter's rational approximation of G1.
    #[inline]
    fn masking(&self, c: f32) -> f32 {
        let tan = (1.0 - c * c).max(0.0).sqrt() / c;
        let a = 1.0 / (self.alpha * tan);
        if a < 1.6 {
            (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
        } else {
            1.0
        }
    }
}

/// Two unit vectors that complete `n` to a right-handed frame (Duff et al., JCGT 2017).
#[inline(always)]
pub(crate) fn frame(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (
        Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x),
        Vec3::new(b, sign + n.y * n.y * a, -n.y),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Stream;

    #[test]
    fn sampling_weights_agree_with_density_and_energy_stays_below_one() {
        let n = Vec3::new(0.2, -0.5, 0.8).normalized();
        let (t, _) = frame(n);
        for alpha in [0.0, 0.01, 0.1, 0.4] {
            for grazing in [0.1f32, 0.7, 1.2] {
                let i = (n + t * libm::tanf(grazing)).normalized();
                let s = Surface {
                    strength: if alpha == 0.0 { 1.0 / PI } else { 1.0 },
                    alpha,
                    two_sided: true,
                    specular: false,
                };
                let mut rng = Rng::new(1, Stream::Paths, 0, 0);
                let (mut sum, count) = (0.0f64, 20_000);
                for _ in 0..count {
                    if let Some((o, w, pdf)) = s.sample(n, i, &mut rng) {
                        sum += f64::from(w);
                        let expected = s.scatter(n, i, o) / pdf;
                        assert!((w - expected).abs() < 2e-2 * w, "{alpha} {w} {expected}");
                        assert!((s.pdf(n, i, o) - pdf).abs() <= 1e-2 * pdf);
                    }
                }
                let albedo = sum / f64::from(count);
                assert!(albedo < 1.02, "{alpha} {grazing} {albedo}");
            }
        }
    }

    #[test]
    fn scattering_is_reciprocal() {
        let n = Vec3::new(0.0, 1.0, 0.0);
        let a = Vec3::new(0.3, 1.0, 0.1).normalized();
        let b = Vec3::new(-0.4, 0.8, 0.2).normalized();
        let s = Surface {
            strength: 0.9,
            alpha: 0.3,
            two_sided: true,
            specular: false,
        };
        let (ab, ba) = (s.scatter(n, a, b) / n.dot(b), s.scatter(n, b, a) / n.dot(a));
        assert!((ab - ba).abs() < 1e-5 * ab);
    }
}
