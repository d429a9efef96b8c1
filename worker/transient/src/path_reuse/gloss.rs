//! What arrives at rough vertices, laid out so that each pair of vertex and pixel weighs all of it side by side.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use super::{Arrivals, Shared};
use crate::bsdf::Surface;

/// How many arrivals are weighed in one go: those behind the last one of a vertex are not looked at. A loop of so many is long enough for
/// the compiler to work on several at once, and has no rest that it would do one by one.
const GROUP: usize = 16;

/// By arrival, as in [`Arrivals`]; of vertices that are not rough anything, and empty where there are none.
#[derive(Debug, Default)]
pub(super) struct Gloss {
    /// Unit direction from which it arrives.
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    /// Its cosine.
    cos: Vec<f32>,
    /// What the conductor sends on, less what the other direction has to do with it.
    conductor: Vec<f32>,
    /// What the Lambertian part sends on.
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
                    // In place of the white Lambertian's 1/π.
                    let value = PI * arrivals.value[k];
                    let (lambertian, conductor) = surface.arriving(cos);
                    self.lambertian[k] = value * lambertian;
                    self.conductor[k] = value * conductor;
                }
            }
        }
    }

    /// Writes what a rough vertex sends on in the unit direction `to` of each of its arrivals, and more up to a whole group.
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
        // What the conductor does with light of each arrival; a loop for each of its kinds.
        macro_rules! send {
            ($lobe:ident) => {
                for (g, out) in out.iter_mut().enumerate() {
                    let (x, y, z, cosines) = (&x[g], &y[g], &z[g], &cosines[g]);
                    let (lambertian, conductor) = (&lambertian[g], &conductor[g]);
                    for k in 0..GROUP {
                        let along = to.x * x[k] + to.y * y[k] + to.z * z[k];
                        // Of the sum of both directions: its square, and its part along the normal.
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
