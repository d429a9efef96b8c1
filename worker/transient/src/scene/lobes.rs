//! Scattering at many surface points at once. Each point has a fixed direction of its own and
//! scatters towards or from one common point.
//!
//! Supports GGX and Beckmann conductors, Lambertians and mixes of both. If no surface is Beckmann,
//! its terms are not computed.

use std::ops::Range;

use picofarm_scene::Vec3;

use crate::{
    numeric::lanes::{Column, SIDE, Wide, put, widest},
    scene::{
        hit::Hit,
        lobe::{Lobe, dot},
        surface::Surface,
    },
};

#[inline(always)]
fn array(v: Vec3) -> [f32; 3] {
    [v.x, v.y, v.z]
}

/// A surface point, its normal and its fixed direction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    pub p: Vec3,
    pub n: Vec3,
    pub i: Vec3,
}

impl Seen {
    /// Creates the point of a hit with the fixed direction `i`.
    #[inline]
    pub fn of(h: &Hit, i: Vec3) -> Self {
        Self { p: h.p, n: h.n, i }
    }
}

/// The lobes of many surface points, in columns.
#[derive(Debug, Default, Clone)]
pub(crate) struct Lobes {
    p: [Column; 3],
    n: [Column; 3],
    i: [Column; 3],
    conductor: Column,
    lambertian: Column,
    alpha2: Column,
    conductor_pdf: Column,
    lambertian_pdf: Column,
    beckmann: Column,
    /// Whether any of them has a Beckmann conductor.
    any_beckmann: bool,
}

impl Lobes {
    pub fn clear(&mut self) {
        let columns = self.p.iter_mut().chain(&mut self.n).chain(&mut self.i);
        columns.for_each(Column::clear);
        for column in [
            &mut self.conductor,
            &mut self.lambertian,
            &mut self.alpha2,
            &mut self.conductor_pdf,
            &mut self.lambertian_pdf,
            &mut self.beckmann,
        ] {
            column.clear();
        }
        self.any_beckmann = false;
    }

    pub fn push(&mut self, place: &Seen, surface: &Surface) {
        for (columns, v) in [
            (&mut self.p, place.p),
            (&mut self.n, place.n),
            (&mut self.i, place.i),
        ] {
            for (column, x) in columns.iter_mut().zip(array(v)) {
                column.push(x);
            }
        }
        let lobe = surface.lobe_from(place.n.dot(place.i));
        self.any_beckmann |= lobe.beckmann > 0.0;
        self.beckmann.push(lobe.beckmann);
        self.conductor.push(lobe.conductor);
        self.lambertian.push(lobe.lambertian);
        self.alpha2.push(lobe.alpha2);
        self.conductor_pdf.push(lobe.conductor_pdf);
        self.lambertian_pdf.push(lobe.lambertian_pdf);
    }

    /// Writes f·cos of each point towards the point `q` with normal `nq`, and its sampling density,
    /// both per area at `q`.
    pub fn toward(&self, (q, nq): (Vec3, Vec3), value: &mut [f32], pdf: &mut [f32]) {
        widest(Toward {
            lobes: self,
            q,
            nq,
            value,
            pdf,
        });
    }

    /// Writes the light that a point scatters from each point of a range, f_x cos_x f_y cos_y / d²,
    /// and the density per area there with which the point samples it.
    pub fn between(
        &self,
        range: Range<usize>,
        (place, surface): (&Seen, &Surface),
        value: &mut [f32],
        pdf: &mut [f32],
    ) {
        let lobe = surface.lobe_from(place.n.dot(place.i));
        widest(Between {
            lobes: self,
            range,
            place: *place,
            lobe,
            value,
            pdf,
        });
    }
}

/// One group of [`SIDE`] lobes.
struct Group<'a> {
    p: [&'a [f32; SIDE]; 3],
    n: [&'a [f32; SIDE]; 3],
    i: [&'a [f32; SIDE]; 3],
    conductor: &'a [f32; SIDE],
    lambertian: &'a [f32; SIDE],
    alpha2: &'a [f32; SIDE],
    conductor_pdf: &'a [f32; SIDE],
    lambertian_pdf: &'a [f32; SIDE],
    beckmann: &'a [f32; SIDE],
}

/// The groups of a range, the same number for each column.
struct Groups<'a> {
    p: [&'a [[f32; SIDE]]; 3],
    n: [&'a [[f32; SIDE]]; 3],
    i: [&'a [[f32; SIDE]]; 3],
    conductor: &'a [[f32; SIDE]],
    lambertian: &'a [[f32; SIDE]],
    alpha2: &'a [[f32; SIDE]],
    conductor_pdf: &'a [[f32; SIDE]],
    lambertian_pdf: &'a [[f32; SIDE]],
    beckmann: &'a [[f32; SIDE]],
}

impl<'a> Groups<'a> {
    #[inline(always)]
    fn of(lobes: &'a Lobes, first: usize, count: usize) -> Self {
        let groups = count.div_ceil(SIDE);
        let of = |column: &'a Column| &column.groups(first, count)[..groups];
        let each = |columns: &'a [Column; 3]| [of(&columns[0]), of(&columns[1]), of(&columns[2])];
        Self {
            p: each(&lobes.p),
            n: each(&lobes.n),
            i: each(&lobes.i),
            conductor: of(&lobes.conductor),
            lambertian: of(&lobes.lambertian),
            alpha2: of(&lobes.alpha2),
            conductor_pdf: of(&lobes.conductor_pdf),
            lambertian_pdf: of(&lobes.lambertian_pdf),
            beckmann: of(&lobes.beckmann),
        }
    }

    #[inline(always)]
    fn group(&self, k: usize) -> Group<'a> {
        let of =
            |columns: &[&'a [[f32; SIDE]]; 3]| [&columns[0][k], &columns[1][k], &columns[2][k]];
        Group {
            p: of(&self.p),
            n: of(&self.n),
            i: of(&self.i),
            conductor: &self.conductor[k],
            lambertian: &self.lambertian[k],
            alpha2: &self.alpha2[k],
            conductor_pdf: &self.conductor_pdf[k],
            lambertian_pdf: &self.lambertian_pdf[k],
            beckmann: &self.beckmann[k],
        }
    }
}

impl Group<'_> {
    #[inline(always)]
    fn lobe(&self, k: usize) -> Lobe {
        Lobe {
            conductor: self.conductor[k],
            lambertian: self.lambertian[k],
            alpha2: self.alpha2[k],
            conductor_pdf: self.conductor_pdf[k],
            lambertian_pdf: self.lambertian_pdf[k],
            beckmann: self.beckmann[k],
        }
    }
}

#[inline(always)]
fn at(columns: &[&[f32; SIDE]; 3], k: usize) -> [f32; 3] {
    [columns[0][k], columns[1][k], columns[2][k]]
}

/// The loop of [`Lobes::toward`].
struct Toward<'a> {
    lobes: &'a Lobes,
    q: Vec3,
    nq: Vec3,
    value: &'a mut [f32],
    pdf: &'a mut [f32],
}

impl Wide for Toward<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        match self.lobes.any_beckmann {
            false => self.all::<false>(),
            true => self.all::<true>(),
        }
    }
}

impl Toward<'_> {
    #[inline(always)]
    fn all<const BECKMANN: bool>(self) {
        let count = self.value.len();
        let groups = Groups::of(self.lobes, 0, count);
        let (q, nq) = (array(self.q), array(self.nq));
        for group in 0..count.div_ceil(SIDE) {
            let c = groups.group(group);
            let (mut value, mut pdf) = ([0.0; SIDE], [0.0; SIDE]);
            for k in 0..SIDE {
                let p = at(&c.p, k);
                let to = [q[0] - p[0], q[1] - p[1], q[2] - p[2]];
                let d2 = dot(to, to);
                let scale = 1.0 / d2.sqrt();
                let w = [to[0] * scale, to[1] * scale, to[2] * scale];
                let (f, density) = c.lobe(k).scatter::<BECKMANN>(at(&c.n, k), at(&c.i, k), w);
                let turn = dot(nq, w).abs() * (scale * scale);
                // Points at the same position have no direction between them.
                value[k] = if f > 0.0 { f * turn } else { 0.0 };
                pdf[k] = if density > 0.0 { density * turn } else { 0.0 };
            }
            put(self.value, group, &value);
            put(self.pdf, group, &pdf);
        }
    }
}

/// The loop of [`Lobes::between`].
struct Between<'a> {
    lobes: &'a Lobes,
    range: Range<usize>,
    place: Seen,
    lobe: Lobe,
    value: &'a mut [f32],
    pdf: &'a mut [f32],
}

impl Wide for Between<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        match self.lobes.any_beckmann || self.lobe.beckmann > 0.0 {
            false => self.all::<false>(),
            true => self.all::<true>(),
        }
    }
}

impl Between<'_> {
    #[inline(always)]
    fn all<const BECKMANN: bool>(self) {
        let count = self.range.len();
        let groups = Groups::of(self.lobes, self.range.start, count);
        let (out, out_pdf) = (&mut self.value[..count], &mut self.pdf[..count]);
        let Seen { p: x, n, i } = self.place;
        let (x, n, i, lobe) = (array(x), array(n), array(i), self.lobe);
        for group in 0..count.div_ceil(SIDE) {
            let c = groups.group(group);
            let (mut value, mut pdf) = ([0.0; SIDE], [0.0; SIDE]);
            for k in 0..SIDE {
                let p = at(&c.p, k);
                let to = [p[0] - x[0], p[1] - x[1], p[2] - x[2]];
                let d2 = dot(to, to);
                let scale = 1.0 / d2.sqrt();
                let w = [to[0] * scale, to[1] * scale, to[2] * scale];
                let (here, density) = lobe.scatter::<BECKMANN>(n, i, w);
                let back = [-w[0], -w[1], -w[2]];
                let ny = at(&c.n, k);
                let (there, _) = c.lobe(k).scatter::<BECKMANN>(ny, at(&c.i, k), back);
                let less = scale * scale;
                let (f, turn) = (here * there, dot(ny, w).abs() * less);
                // Points at the same position have no direction between them.
                value[k] = if f > 0.0 { f * less } else { 0.0 };
                pdf[k] = if density > 0.0 { density * turn } else { 0.0 };
            }
            put(out, group, &value);
            put(out_pdf, group, &pdf);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use picofarm_scene::{Bsdf, Distribution, Material};
    use proptest::prelude::*;

    use super::*;

    fn unit() -> impl Strategy<Value = Vec3> {
        let axis = || -1.0f32..1.0;
        (axis(), axis(), axis())
            .prop_map(|(x, y, z)| Vec3::new(x, y, z))
            .prop_filter("has a direction", |v| v.length() > 0.1)
            .prop_map(Vec3::normalized)
    }

    fn surface() -> impl Strategy<Value = Surface> {
        (0.02f32..0.9, 0.0f32..1.0, 0u8..3, any::<bool>()).prop_map(|(alpha, weight, kind, ggx)| {
            let distribution = if ggx {
                Distribution::Ggx
            } else {
                Distribution::Beckmann
            };
            let bsdf = match kind {
                0 => Bsdf::Diffuse { reflectance: 0.7 },
                1 => Bsdf::RoughConductor {
                    alpha,
                    distribution,
                    reflectance: 0.8,
                },
                _ => Bsdf::Mixed {
                    reflectance: 0.6,
                    alpha,
                    distribution,
                    specular_reflectance: 0.9,
                    weight,
                },
            };
            Surface::new(&Material {
                bsdf,
                ..Material::diffuse("any", [0.5; 3])
            })
        })
    }

    fn near(a: f32, b: f32) -> bool {
        (a - b).abs() <= 2e-3 * a.abs().max(b.abs()) + 1e-6
    }

    proptest! {
        #[test]
        fn points_side_by_side_scatter_as_each_alone(
            all in prop::collection::vec((unit(), unit(), unit(), surface()), 1..20),
            x in unit(), n in unit(), i in unit(), own in surface(),
        ) {
            let mut lobes = Lobes::default();
            for (p, n, i, s) in &all {
                lobes.push(&Seen { p: *p * 3.0, n: *n, i: *i }, s);
            }
            let (mut value, mut pdf) = (vec![0.0; all.len()], vec![0.0; all.len()]);
            lobes.toward((x, n), &mut value, &mut pdf);
            for (k, (p, np, ip, s)) in all.iter().enumerate() {
                let to = x - *p * 3.0;
                let (d2, w) = (to.dot(to), to.normalized());
                let turn = n.dot(w).abs() / d2;
                prop_assert!(near(value[k], s.scatter(*np, *ip, w) * turn));
                prop_assert!(near(pdf[k], s.pdf(*np, *ip, w) * turn));
            }
            let place = Seen { p: x, n, i };
            lobes.between(0..all.len(), (&place, &own), &mut value, &mut pdf);
            for (k, (p, np, ip, s)) in all.iter().enumerate() {
                let to = *p * 3.0 - x;
                let (d2, w) = (to.dot(to), to.normalized());
                let expected = own.scatter(n, i, w) * s.scatter(*np, *ip, -w) / d2;
                prop_assert!(near(value[k], expected));
                prop_assert!(near(pdf[k], own.pdf(n, i, w) * np.dot(w).abs() / d2));
            }
        }
    }

    #[test]
    fn there_is_no_light_between_points_in_one_place_or_from_beneath() {
        let (p, n) = (Vec3::ZERO, Vec3::new(0.0, 0.0, 1.0));
        let rough = Surface::new(&Material {
            bsdf: Bsdf::RoughConductor {
                alpha: 0.3,
                distribution: Distribution::Ggx,
                reflectance: 1.0,
            },
            ..Material::diffuse("any", [0.5; 3])
        });
        for i in [n, -n, Vec3::new(1.0, 0.0, 0.0)] {
            let seen = Seen { p, n, i };
            let mut lobes = Lobes::default();
            lobes.push(&seen, &rough);
            let above = n * 2.0;
            for q in [p, if i == n { -above } else { above }] {
                let (mut value, mut pdf) = ([1.0], [1.0]);
                lobes.toward((q, n), &mut value, &mut pdf);
                assert_eq!((value, pdf), ([0.0], [0.0]), "{i:?} {q:?}");
                let at = Seen { p: q, n: -n, i: -n };
                lobes.between(0..1, (&at, &rough), &mut value, &mut pdf);
                assert_eq!(value, [0.0], "{i:?} {q:?}");
                assert!(pdf[0].is_finite());
            }
        }
    }

    #[test]
    fn the_constants_are_those_of_a_lambertian() {
        let lobe = Surface::new(&Material::diffuse("half", [0.5; 3])).lobe_from(0.3);
        assert_eq!((lobe.conductor, lobe.conductor_pdf), (0.0, 0.0));
        assert_eq!(lobe.lambertian_pdf, 1.0 / PI);
        assert_eq!(lobe.lambertian, 0.5 / PI);
    }
}
