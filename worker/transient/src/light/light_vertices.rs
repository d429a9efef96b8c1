//! Light vertices: surface points that spots light directly, drawn along the spots' own scattering
//! and stored for a batch of camera paths. A camera vertex sees them as points of light. Combined
//! with plain connections by MIS, they bound both 1/d² singularities of paths of three bounces and
//! more: the one at the spot and the one at the camera vertex.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    light::{columns::Columns, emitters::Emitters},
    scene::{
        hit::Hit,
        lobes::{Lobes, Seen},
    },
};

/// One light vertex.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LightVertex {
    pub hit: Hit,
    /// Unit direction back towards the spot.
    pub back: Vec3,
    /// Arriving flux, divided by the number of vertices drawn.
    pub flux: f32,
    /// Density per area of drawing it, times the weight of this technique in MIS.
    pub density: f32,
    /// Optical path from the laser, metres.
    pub path_m: f64,
    /// Emitter index.
    pub spot: usize,
    /// Bounces up to and including this vertex, counted from the spot as the first.
    pub bounces: u32,
    /// Roughness of the first near-mirror on the light's path; 0 if there was none.
    pub alpha: f32,
}

/// Density of a light vertex that no other technique samples: its MIS weight is 1 to the last bit.
pub(crate) const ALONE: f32 = 1e30;

/// The light vertices of one batch.
#[derive(Debug, Default)]
pub(crate) struct LightVertices {
    pub list: Vec<LightVertex>,
    columns: Columns,
    /// Indices of the vertices that are not Lambertian.
    glossy: Vec<usize>,
    /// The lobe of each vertex for the arriving light.
    lobes: Lobes,
}

impl LightVertices {
    /// Removes all vertices.
    pub fn clear(&mut self) {
        self.list.clear();
        self.glossy.clear();
        self.columns.clear();
        self.lobes.clear();
    }

    /// Adds a vertex.
    pub fn push(&mut self, y: LightVertex) {
        let lambert = if y.hit.surface.diffuse() {
            y.hit.surface.lambertian()
        } else {
            self.glossy.push(self.list.len());
            0.0
        };
        self.columns.push(y.hit.p, y.hit.n, y.flux * lambert);
        self.lobes.push(&Seen::of(&y.hit, y.back), &y.hit.surface);
        self.list.push(y);
    }

    /// Writes the unshadowed contribution of every vertex to a surface point, including the MIS
    /// weight.
    pub fn weights(&self, x: &Hit, wo: Vec3, (out, plain): (&mut Vec<f32>, &mut Vec<f32>)) {
        out.clear();
        out.resize(self.list.len(), 0.0);
        if x.surface.diffuse() && self.glossy.is_empty() {
            self.columns.irradiance(x.p, x.n, out);
            for ((w, y), &s) in out.iter_mut().zip(&self.list).zip(&*self.columns.strength) {
                // irradiance / strength = cos cos / d²: the density of BSDF sampling times π.
                let plain = *w / (s * PI);
                let share = y.density / (y.density + plain);
                *w = if *w > 0.0 {
                    *w * x.surface.lambertian() * share
                } else {
                    0.0
                };
            }
            return;
        }
        plain.resize(out.len(), 0.0);
        let (place, all) = (Seen::of(x, wo), 0..out.len());
        self.lobes.between(all, (&place, &x.surface), out, plain);
        for ((w, y), plain) in out.iter_mut().zip(&self.list).zip(plain) {
            *w *= y.flux * y.density / (y.density + *plain);
        }
    }

    /// Returns whether [`LightVertices::glossy_weights`] can be nonzero.
    pub fn has_gloss(&self) -> bool {
        let gloss = |&i: &usize| !self.list[i].hit.surface.is_shared();
        self.glossy.iter().any(gloss)
    }

    /// Like [`LightVertices::weights`], only for conductors with vertices that a tile does not
    /// share.
    pub fn glossy_weights(&self, x: &Hit, wo: Vec3, out: &mut Vec<f32>) {
        out.clear();
        out.resize(self.list.len(), 0.0);
        for &i in &self.glossy {
            if !self.list[i].hit.surface.is_shared() {
                out[i] = self.weight(i, x, wo);
            }
        }
    }

    fn weight(&self, i: usize, x: &Hit, wo: Vec3) -> f32 {
        let y = &self.list[i];
        let to = y.hit.p - x.p;
        let d2 = to.dot(to);
        let w = to / d2.sqrt();
        let cos = -y.hit.n.dot(w);
        if !(cos > 0.0 && x.n.dot(w) > 0.0) {
            return 0.0;
        }
        let value = x.surface.scatter(x.n, wo, w) * y.hit.surface.scatter(y.hit.n, y.back, -w);
        let plain = x.surface.pdf(x.n, wo, w) * cos / d2;
        value * y.flux / d2 * y.density / (y.density + plain)
    }
}

/// Returns the density per steradian at a spot, times the MIS weight of this technique. Both sides
/// of the balance heuristic must use it.
#[inline(always)]
pub(crate) fn share(emitters: &Emitters, pdf: f32) -> f32 {
    LIGHT_WEIGHT * pdf / emitters.list.len() as f32
}

/// Light vertices count as this many samples against one BSDF sample.
pub(crate) const LIGHT_WEIGHT: f32 = 8.0;
