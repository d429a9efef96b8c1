//! The scattering of one surface point for a fixed direction.

use crate::numeric::exponential::exp_minus;

/// The scattering of a surface point for a fixed direction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lobe {
    /// f · cos / (D·π·α²·G₁) of the conductor, for the G₁ of the other direction.
    pub conductor: f32,
    /// ρ/π of the Lambertian part.
    pub lambertian: f32,
    /// α².
    pub alpha2: f32,
    /// Sampling density of the conductor / (D·π·α²).
    pub conductor_pdf: f32,
    /// Sampling density of the Lambertian part, without the cosine.
    pub lambertian_pdf: f32,
    /// 1 for a Beckmann conductor, otherwise 0.
    pub beckmann: f32,
}

impl Lobe {
    /// The lobe of a surface that scatters nothing.
    pub const BLACK: Self = Self {
        conductor: 0.0,
        lambertian: 0.0,
        alpha2: 1.0,
        conductor_pdf: 0.0,
        lambertian_pdf: 0.0,
        beckmann: 0.0,
    };

    /// Returns f·cos for the direction `w`, and its sampling density per steradian. `n` is the
    /// normal, `i` the fixed direction. `BECKMANN` states whether the surface may be a Beckmann
    /// conductor.
    #[inline(always)]
    pub fn scatter<const BECKMANN: bool>(
        &self,
        n: [f32; 3],
        i: [f32; 3],
        w: [f32; 3],
    ) -> (f32, f32) {
        let co = dot(n, w);
        let s = [i[0] + w[0], i[1] + w[1], i[2] + w[2]];
        let c = dot(n, s);
        // The slope is computed from n × s, because 1 − cos² would cancel at small α.
        let x = [
            n[1] * s[2] - n[2] * s[1],
            n[2] * s[0] - n[0] * s[2],
            n[0] * s[1] - n[1] * s[0],
        ];
        let (along2, across2) = (c * c, dot(x, x));
        // Both are multiplied by α². GGX's D·π·α² is (part / whole)², and its G₁ is 2cos / (cos +
        // root); one division computes both. The sum of opposite directions is 0, so a small number
        // avoids a division by 0.
        let part = (along2 + across2) * self.alpha2;
        let whole = along2 * self.alpha2 + across2 + 1e-16;
        let edge = co + (co * co + self.alpha2 * (1.0 - co * co).max(0.0)).sqrt();
        let once = part * part / (whole * whole * edge);
        let (mut d, mut dg) = (once * edge, once * (2.0 * co));
        if BECKMANN && self.beckmann > 0.0 {
            let square = along2 + across2;
            let cos2 = along2 / square;
            let x = across2 / (along2 * self.alpha2);
            d = exp_minus(x) / (cos2 * cos2);
            let tan2 = (1.0 - co * co).max(0.0) / (co * co);
            dg = d * beckmann_masking(1.0 / (self.alpha2 * tan2).sqrt());
        }
        let f = self.lambertian * co + self.conductor * dg;
        let pdf = self.lambertian_pdf * co + self.conductor_pdf * d;
        let lit = co > 0.0;
        (if lit { f } else { 0.0 }, if lit { pdf } else { 0.0 })
    }
}

/// Returns Walter's rational approximation of G₁ for `a` = 1/(α·tan θ).
#[inline(always)]
pub(crate) fn beckmann_masking(a: f32) -> f32 {
    let rational = (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a);
    if a < 1.6 { rational } else { 1.0 }
}

#[inline(always)]
pub(crate) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
