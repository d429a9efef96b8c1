//! Scattering: Lambertian, rough conductor (Beckmann or GGX; Walter et al., EGSR 2007) and the mix of
//! both, for two directions on the same side of a facet.

mod beckmann;

use std::f32::consts::PI;

use picofarm_scene::{Bsdf, Distribution, Material, Vec3};

use crate::{
    lobes::{Lobe, beckmann_masking, exp_minus},
    rng::Rng,
};

/// How a surface scatters: the kinds that the renderer knows. A new kind is a variant here, its density, pdf and draw in this
/// file, and a variant of [`Bsdf`]; the rest of the renderer asks a [`Surface`] what it can do and knows no kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// ρ/π.
    Lambertian,
    /// A rough conductor.
    Conductor,
    /// A Lambertian beside a rough conductor.
    Mixed,
}

/// Flags of a surface, one bit each.
const TWO_SIDED: u8 = 1;
const SPECULAR: u8 = 2;
const GGX: u8 = 4;

/// Roughness from which pixels share a conductor's vertices. There its lobe is wide enough to be weighed pixel by pixel for
/// light that was found for one of them; beneath, that costs more than it brings (measured at 0.12 and 0.2).
const SHARED_ALPHA: f32 = 0.15;

/// A material's scattering, ready for use. Sixteen bytes: every hit carries one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    kind: Kind,
    flags: u8,
    /// Lambertian: ρ/π. Conductor, also as a part of a mix: its reflectance times its share. 0 = black.
    strength: f32,
    /// Roughness of a conductor; of others 0.
    alpha: f32,
    /// Lambertian part ρ/π of a mix times its share; of others 0.
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
                // A mix has two parts that scatter; with one it is pure.
                if base == 0.0 {
                    of(Kind::Conductor, strength, alpha, 0.0)
                } else if strength == 0.0 {
                    of(Kind::Lambertian, base, 0.0, 0.0)
                } else {
                    of(Kind::Mixed, strength, alpha, base)
                }
            }
            // Thin glass is no surface (see `glass`); what bodies of glass do is no scattering (see `by_glass`).
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => {
                of(Kind::Lambertian, 0.0, 0.0, 0.0)
            }
        }
    }

    /// A mix to draw directions by at a vertex that pixels share: as this surface scatters, half of it or more Lambertian, of
    /// albedo 1.
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

    /// Counts as a mirror (specular mask).
    #[inline(always)]
    pub fn specular(&self) -> bool {
        self.flags & SPECULAR != 0
    }

    /// The same surface, scattering nothing.
    pub fn black(self) -> Self {
        self.scaled(0.0)
    }

    /// The same surface, scattering `factor` times as much.
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

    /// Pixels may share its vertices: a Lambertian, or a conductor that is rough enough.
    #[inline(always)]
    pub fn is_shared(&self) -> bool {
        self.diffuse() || self.alpha >= SHARED_ALPHA
    }

    /// A Lambertian of albedo 1 in its place.
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

    /// Scatters nothing.
    #[inline(always)]
    pub fn is_black(&self) -> bool {
        self.strength == 0.0
    }

    /// True for Lambertian surfaces.
    #[inline(always)]
    pub fn diffuse(&self) -> bool {
        matches!(self.kind, Kind::Lambertian)
    }

    /// True for a mix of two parts, of which [`Surface::lobe`] chooses.
    #[inline(always)]
    pub fn is_mixed(&self) -> bool {
        matches!(self.kind, Kind::Mixed)
    }

    /// True for a mix of which a path must settle on one part: all but those whose vertices pixels share. Their
    /// lobes are both wide, so that a vertex can scatter by both.
    #[inline(always)]
    pub fn is_open(&self) -> bool {
        match self.kind {
            Kind::Mixed => !self.is_shared(),
            Kind::Lambertian | Kind::Conductor => false,
        }
    }

    /// BRDF of a Lambertian surface, ρ/π.
    #[inline(always)]
    pub fn lambertian(&self) -> f32 {
        self.strength
    }

    /// Roughness α of its conductor, 0 without one.
    #[inline(always)]
    pub fn alpha(&self) -> f32 {
        self.alpha
    }

    /// Its conductor, if it has one, is GGX.
    #[inline(always)]
    pub fn ggx(&self) -> bool {
        self.flags & GGX != 0
    }

    /// Has a conductor that is smooth enough for a mirror, alone or in a mix.
    #[inline(always)]
    pub fn has_mirror(&self) -> bool {
        !self.diffuse() && !self.is_rough() && !self.is_black()
    }

    /// Has a conductor that is too rough for a mirror.
    #[inline(always)]
    pub fn is_rough(&self) -> bool {
        self.alpha > Material::SPECULAR_ALPHA
    }

    /// One part of a mix, chosen by `u` in [0, 1) in proportion to the parts' albedos and divided by the
    /// chance of that choice, with `specular` as for the part alone. Pure surfaces are their own part.
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

    /// The conductor alone, as it is in a mix. Pure surfaces stay what they are.
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

    /// Chance with which [`Surface::sample`] draws from the conductor of a mix.
    #[inline(always)]
    fn share(&self) -> f32 {
        self.strength / (self.strength + self.base * PI)
    }

    /// f · cos(n, o) for unit directions `i` and `o`, both leaving the surface.
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

    /// The same of what is not Lambertian, with the cosines of both.
    #[inline]
    fn scatter_rough(&self, n: Vec3, i: Vec3, o: Vec3, (ci, co): (f32, f32)) -> f32 {
        let d = self.density(n, i + o);
        if d == 0.0 {
            return self.base * co;
        }
        self.strength * d * self.masking(ci) * self.masking(co) / (4.0 * ci) + self.base * co
    }

    /// How it scatters light from a direction with cosine `c`, for many directions side by side; nothing from beneath.
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

    /// The BRDF of a surface that is not Lambertian, from a direction with cosine `c` to another, is the first number here plus the
    /// second times [`Surface::leaving`] and [`Surface::lobe_ggx`] or [`Surface::lobe_beckmann`] of the other.
    pub fn arriving(&self, c: f32) -> (f32, f32) {
        let a2 = self.alpha * self.alpha;
        (self.base, self.strength * self.leaving(c) / (4.0 * PI * a2))
    }

    /// G₁ over the cosine `c`, above the surface; see [`Surface::arriving`].
    pub fn leaving(&self, c: f32) -> f32 {
        let leaving = match self.ggx() {
            true => 2.0 / self.edge(c),
            false => self.masking(c) / c,
        };
        if leaving.is_finite() { leaving } else { 0.0 }
    }

    /// G₁ over the cosine `c` by which facets are drawn that a direction sees: Smith's of either distribution, to the last digits, as
    /// draws follow it.
    #[inline]
    fn seen(&self, c: f32) -> f32 {
        match self.ggx() {
            true => self.leaving(c),
            false => beckmann::seen(self.alpha, c),
        }
    }

    /// See [`Surface::arriving`]: D·π·α² of GGX by the squares of the sum of both directions and of its part along the normal. For
    /// lobes wide enough that their difference does not cancel.
    #[inline(always)]
    pub fn lobe_ggx(&self, square: f32, along2: f32) -> f32 {
        let (across2, a2) = ((square - along2).max(0.0), self.alpha * self.alpha);
        let t = square * a2 / (along2 * a2 + across2 + f32::MIN_POSITIVE);
        t * t
    }

    /// The same of Beckmann.
    #[inline(always)]
    pub fn lobe_beckmann(&self, square: f32, along2: f32) -> f32 {
        let across2 = (square - along2).max(0.0);
        let x = across2 / (along2 * self.alpha * self.alpha);
        let cos2 = along2 / square;
        let lobe = exp_minus(x) / (cos2 * cos2);
        if lobe > 0.0 { lobe } else { 0.0 }
    }

    /// Draws a direction for `i`: (direction, f·cos/pdf, pdf per steradian); `None` where none leaves.
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
        // Of a direction beneath the surface no facet is seen: to draw one would take without end.
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
        // 1 but for what Walter's approximation is off.
        let approximated = match self.ggx() {
            true => 1.0,
            false => self.leaving(ci) / seen,
        };
        let weight = self.strength * approximated * self.masking(co);
        Some((o, weight, 0.25 * seen * self.density(n, i + o)))
    }

    /// Density per steradian with which [`Surface::sample`] draws `o`.
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

    /// D(h) for h along `sum` = i + o. The slope comes from n × h: 1 − cos² would cancel at small α.
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

    /// G1: Smith's for GGX, Walter's rational approximation for Beckmann.
    #[inline]
    fn masking(&self, c: f32) -> f32 {
        if self.ggx() {
            return 2.0 * c / self.edge(c);
        }
        let tan = (1.0 - c * c).max(0.0).sqrt() / c;
        beckmann_masking(1.0 / (self.alpha * tan))
    }

    /// 2cos / G1 of GGX.
    #[inline(always)]
    fn edge(&self, c: f32) -> f32 {
        let c2 = c * c;
        c + (c2 + self.alpha * self.alpha * (1.0 - c2).max(0.0)).sqrt()
    }
}

/// A cosine-distributed direction around `n`, and its cosine.
#[inline]
fn cosine(n: Vec3, rng: &mut Rng) -> Option<(Vec3, f32)> {
    let (t, b) = frame(n);
    let (x, y, r2) = rng.disc();
    let z = (1.0 - r2).sqrt();
    let o = (t * x + b * y + n * z).normalized();
    let c = n.dot(o);
    (c > 0.0).then_some((o, c))
}

/// A half vector of GGX among those that `i` sees, in the surface's frame and of any length (Heitz, JCGT
/// 2018): its weights never exceed 1, however rough or grazing.
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
#[path = "bsdf/tests.rs"]
mod tests;
