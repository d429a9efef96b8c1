//! Scattering for two directions on the same side of a facet: Lambertian, rough conductor (Beckmann
//! or GGX; Walter et al., EGSR 2007) and a mix of both.

mod beckmann;

use std::f32::consts::PI;

use picofarm_scene::{Bsdf, Distribution, Material, Vec3};

use crate::{
    lobes::{Lobe, beckmann_masking, exp_minus},
    rng::Rng,
};

/// The scattering models of the renderer. A new model is a variant here, its density, pdf and
/// sampling in this file, and a variant of [`Bsdf`]. The rest of the renderer queries the
/// properties of a [`Surface`] and does not match on models.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// ρ/π.
    Lambertian,
    /// A rough conductor.
    Conductor,
    /// A weighted sum of a Lambertian and a rough conductor.
    Mixed,
}

/// Flags of a surface, one bit each.
const TWO_SIDED: u8 = 1;
const SPECULAR: u8 = 2;
const GGX: u8 = 4;

/// Roughness from which pixels share a conductor's vertices. From there on, its lobe is wide enough
/// to evaluate light sampled for one pixel at the others; below it, sharing costs more than it
/// gains (measured at 0.12 and 0.2).
const SHARED_ALPHA: f32 = 0.15;

/// A material's scattering, ready for use. Sixteen bytes: every hit carries one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    kind: Kind,
    flags: u8,
    /// Lambertian: ρ/π. Conductor, also as a part of a mix: its reflectance times its share. 0 =
    /// black.
    strength: f32,
    /// Roughness of a conductor; of others 0.
    alpha: f32,
    /// Lambertian part ρ/π of a mix times its share; 0 for other surfaces.
    base: f32,
}

const _: () = assert!(size_of::<Surface>() == 16);

impl Surface {
    pub fn new(m: &Material) -> Self {
        let ggx = match m.bsdf {
            Bsdf::RoughConductor { distribution, .. } | Bsdf::Mixed { distribution, .. } => {
                distribution == Distribution::Ggx
            }
            Bsdf::Diffuse { .. } | Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => false,
        };
        let flag = |set: bool, flag: u8| if set { flag } else { 0 };
        let of = |kind, strength, alpha, base| Self {
            kind,
            flags: flag(m.two_sided, TWO_SIDED)
                | flag(
                    m.is_specular() && !matches!(m.bsdf, Bsdf::Dielectric { .. }),
                    SPECULAR,
                )
                | flag(ggx && kind != Kind::Lambertian, GGX),
            strength,
            alpha,
            base,
        };
        match m.bsdf {
            Bsdf::Diffuse { reflectance } => of(Kind::Lambertian, reflectance / PI, 0.0, 0.0),
            Bsdf::RoughConductor {
                alpha, reflectance, ..
            } => of(Kind::Conductor, reflectance, alpha, 0.0),
            Bsdf::Mixed {
                reflectance,
                alpha,
                specular_reflectance,
                weight,
                ..
            } => {
                let strength = weight * specular_reflectance;
                let base = (1.0 - weight) * reflectance / PI;
                // A mix has two parts that scatter; with one such part the surface is pure.
                if base == 0.0 {
                    of(Kind::Conductor, strength, alpha, 0.0)
                } else if strength == 0.0 {
                    of(Kind::Lambertian, base, 0.0, 0.0)
                } else {
                    of(Kind::Mixed, strength, alpha, base)
                }
            }
            // Thin glass is no surface (see `glass`); what bodies of glass do is no scattering (see
            // `by_glass`).
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => {
                of(Kind::Lambertian, 0.0, 0.0, 0.0)
            }
        }
    }

    /// A mix to draw directions by at a vertex that pixels share: as this surface scatters, half of
    /// it or more Lambertian, of albedo 1.
    pub fn guide(self) -> Self {
        let base = self.base.max(0.5 * self.albedo() / PI);
        let all = 1.0 / (self.strength + base * PI);
        Self {
            kind: Kind::Mixed,
            strength: self.strength * all,
            base: base * all,
            ..self
        }
    }

    /// Share of light that it sends on, as far as masking lets it.
    #[inline]
    pub fn albedo(&self) -> f32 {
        match self.kind {
            Kind::Lambertian => self.strength * PI,
            _ => self.strength + self.base * PI,
        }
    }

    /// Scatters from both sides.
    #[inline(always)]
    pub fn two_sided(&self) -> bool {
        self.flags & TWO_SIDED != 0
    }

    /// Returns whether the surface counts as a mirror (specular mask).
    #[inline(always)]
    pub fn specular(&self) -> bool {
        self.flags & SPECULAR != 0
    }

    /// Returns the same surface without any scattering.
    pub fn black(self) -> Self {
        self.scaled(0.0)
    }

    /// Returns the same surface with its scattering multiplied by `factor`.
    #[inline(always)]
    pub fn scaled(self, factor: f32) -> Self {
        let scaled = Self {
            strength: self.strength * factor,
            base: self.base * factor,
            ..self
        };
        if scaled.base == 0.0 {
            scaled.gloss()
        } else {
            scaled
        }
    }

    /// Returns whether pixels may share its vertices: for a Lambertian, or a sufficiently rough
    /// conductor.
    #[inline(always)]
    pub fn is_shared(&self) -> bool {
        self.diffuse() || self.alpha >= SHARED_ALPHA
    }

    /// Returns a Lambertian of albedo 1 with the same sides.
    #[inline]
    pub fn white(self) -> Self {
        Self {
            kind: Kind::Lambertian,
            flags: self.flags & TWO_SIDED,
            strength: 1.0 / PI,
            alpha: 0.0,
            base: 0.0,
        }
    }

    /// Returns whether the surface scatters nothing.
    #[inline(always)]
    pub fn is_black(&self) -> bool {
        self.strength == 0.0
    }

    /// Returns whether the surface is Lambertian.
    #[inline(always)]
    pub fn diffuse(&self) -> bool {
        matches!(self.kind, Kind::Lambertian)
    }

    /// Returns whether the surface is a mix of two parts; [`Surface::lobe`] chooses one of them.
    #[inline(always)]
    pub fn is_mixed(&self) -> bool {
        matches!(self.kind, Kind::Mixed)
    }

    /// True for a mix of which a path must settle on one part: all but those whose vertices pixels
    /// share. Their lobes are both wide, so that a vertex can scatter by both.
    #[inline(always)]
    pub fn is_open(&self) -> bool {
        match self.kind {
            Kind::Mixed => !self.is_shared(),
            Kind::Lambertian | Kind::Conductor => false,
        }
    }

    /// Returns the BRDF of a Lambertian surface, ρ/π.
    #[inline(always)]
    pub fn lambertian(&self) -> f32 {
        self.strength
    }

    /// Returns the roughness α of its conductor, 0 without one.
    #[inline(always)]
    pub fn alpha(&self) -> f32 {
        self.alpha
    }

    /// Returns whether its conductor, if it has one, is GGX.
    #[inline(always)]
    pub fn ggx(&self) -> bool {
        self.flags & GGX != 0
    }

    /// Returns whether the surface has a conductor, alone or in a mix, smooth enough for a mirror.
    #[inline(always)]
    pub fn has_mirror(&self) -> bool {
        !self.diffuse() && !self.is_rough() && !self.is_black()
    }

    /// Returns whether the surface has a conductor too rough for a mirror.
    #[inline(always)]
    pub fn is_rough(&self) -> bool {
        self.alpha > Material::SPECULAR_ALPHA
    }

    /// Returns one part of a mix, chosen by `u` in [0, 1) in proportion to the parts' albedos and
    /// divided by the probability of that choice, with `specular` as for the part alone. A pure
    /// surface returns itself.
    #[inline]
    pub fn lobe(&self, u: f32) -> Surface {
        if !self.is_mixed() {
            return *self;
        }
        let total = self.strength + self.base * PI;
        if u * total < self.strength {
            let mirror = self.alpha <= Material::SPECULAR_ALPHA;
            return Self {
                kind: Kind::Conductor,
                flags: self.flags & !SPECULAR | if mirror { SPECULAR } else { 0 },
                strength: total,
                base: 0.0,
                ..*self
            };
        }
        Self {
            kind: Kind::Lambertian,
            flags: self.flags & TWO_SIDED,
            strength: total / PI,
            alpha: 0.0,
            base: 0.0,
        }
    }

    /// Returns the conductor of a mix, with its share. A pure surface returns itself.
    #[inline(always)]
    pub fn gloss(self) -> Self {
        match self.kind {
            Kind::Mixed => Self {
                kind: Kind::Conductor,
                base: 0.0,
                ..self
            },
            Kind::Lambertian | Kind::Conductor => self,
        }
    }

    /// Returns the probability that [`Surface::sample`] draws from the conductor of a mix.
    #[inline(always)]
    fn share(&self) -> f32 {
        self.strength / (self.strength + self.base * PI)
    }

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
    fn scatter_rough(&self, n: Vec3, i: Vec3, o: Vec3, (ci, co): (f32, f32)) -> f32 {
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
    fn seen(&self, c: f32) -> f32 {
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
    fn sample_conductor(&self, n: Vec3, i: Vec3, rng: &mut Rng) -> Option<(Vec3, f32, f32)> {
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
    fn density(&self, n: Vec3, sum: Vec3) -> f32 {
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
    fn masking(&self, c: f32) -> f32 {
        if self.ggx() {
            return 2.0 * c / self.edge(c);
        }
        let tan = (1.0 - c * c).max(0.0).sqrt() / c;
        beckmann_masking(1.0 / (self.alpha * tan))
    }

    /// Returns 2cos / G₁ of GGX.
    #[inline(always)]
    fn edge(&self, c: f32) -> f32 {
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

/// Returns two unit vectors that complete `n` to a right-handed frame (Duff et al., JCGT 2017).
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
#[path = "bsdf/tests.rs"]
mod tests;
