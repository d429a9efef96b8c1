//! The arrivals at rough vertices, laid out so that each pair of vertex and pixel weighs all of
//! them with SIMD.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    paths::path_reuse::{arrivals::Arrivals, shared::Shared},
    scene::surface::Surface,
};

/// The number of arrivals weighed together; results past the last arrival of a vertex are ignored.
/// A loop of this length is long enough for the compiler to vectorise, and has no scalar remainder.
const GROUP: usize = 16;

/// Values by arrival, as in [`Arrivals`]. They are unspecified for vertices that are not rough, and
/// empty if no vertex is rough.
#[derive(Debug, Default)]
pub(crate) struct Gloss {
    /// Unit direction of arrival.
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    /// Cosine of that direction.
    cos: Vec<f32>,
    /// Light scattered by the conductor, without the factors that depend on the outgoing direction.
    conductor: Vec<f32>,
    /// Light scattered by the Lambertian part.
    lambertian: Vec<f32>,
}

impl Gloss {
    /// Lays out the arrivals of all rough vertices.
    pub fn lay(&mut self, shared: &[Shared], arrivals: &Arrivals) {
        let any = shared.iter().any(|y| y.rough.is_some());
        let count = if any { arrivals.bins.len() + GROUP } else { 0 };
        for column in [
            &mut self.x,
            &mut self.y,
            &mut self.z,
            &mut self.cos,
            &mut self.conductor,
            &mut self.lambertian,
        ] {
            column.clear();
            column.resize(count, 0.0);
        }
        for y in shared {
            let Some(surface) = &y.rough else { continue };
            for k in y.first..y.end {
                let from = arrivals.from[k];
                let cos = y.hit.n.dot(from);
                (self.x[k], self.y[k], self.z[k]) = (from.x, from.y, from.z);
                self.cos[k] = cos;
                if cos > 0.0 {
                    // Replaces the white Lambertian's 1/π.
                    let value = PI * arrivals.value[k];
                    let (lambertian, conductor) = surface.arriving(cos);
                    self.lambertian[k] = value * lambertian;
                    self.conductor[k] = value * conductor;
                }
            }
        }
    }

    /// Writes the light that a rough vertex scatters in the unit direction `to` from each of its
    /// arrivals, padded to a whole group.
    #[inline(always)]
    pub fn send<'a>(&'a self, y: &Shared, surface: &Surface, to: Vec3, out: &mut Vec<f32>) {
        let count = (y.end - y.first).next_multiple_of(GROUP);
        out.clear();
        out.resize(count, 0.0);
        let n = y.hit.n;
        let cos = n.dot(to);
        if cos.is_nan() || cos <= 0.0 {
            return;
        }
        let of = |column: &'a [f32]| column[y.first..][..count].as_chunks::<GROUP>().0;
        let (x, y, z) = (of(&self.x), of(&self.y), of(&self.z));
        let (cosines, conductor) = (of(&self.cos), of(&self.conductor));
        let lambertian = of(&self.lambertian);
        let leaving = surface.leaving(cos);
        let (out, _) = out.as_chunks_mut::<GROUP>();
        // The conductor's scattering of each arrival; one loop per kind of conductor.
        macro_rules! send {
            ($lobe:ident) => {
                for (g, out) in out.iter_mut().enumerate() {
                    let (x, y, z, cosines) = (&x[g], &y[g], &z[g], &cosines[g]);
                    let (lambertian, conductor) = (&lambertian[g], &conductor[g]);
                    for k in 0..GROUP {
                        let along = to.x * x[k] + to.y * y[k] + to.z * z[k];
                        // The squared length of the sum of both directions, and its component along
                        // the normal.
                        let (square, c) = (2.0 + 2.0 * along, cos + cosines[k]);
                        let lobe = surface.$lobe(square, c * c);
                        out[k] = lambertian[k] + leaving * conductor[k] * lobe;
                    }
                }
            };
        }
        match surface.ggx() {
            true => send!(lobe_ggx),
            false => send!(lobe_beckmann),
        }
    }
}
