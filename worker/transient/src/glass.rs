//! Thin glass. It is no surface: light goes straight on through it, and a straight way between two points carries the share of
//! light that the panes across it let through. So every technique of the renderer stays what it is, with that share in the place
//! of "free", and the densities of drawing do not change. What glass reflects is left out.
//!
//! The panes have a hierarchy of their own beside that of the surfaces: scenes without glass do not pay for it.

use picofarm_scene::{Bsdf, Material, Vec3};

use crate::{
    api::{RenderError, Stop},
    bvh::{Bvh, Stack, normal},
};

/// Triangles of glass that a ray meets within this length are one, render units: two that share the edge which it meets, and
/// sheets that are there twice.
const SAME: f32 = 1.0 / 65536.0;

/// What of a material's glass counts.
#[derive(Debug, Clone, Copy)]
struct Glass {
    ior: f32,
    /// What a pane lets through beside its reflection: at the laser's wavelength, and of red, green and blue.
    passes: [f32; 4],
    /// One of two faces.
    face: bool,
}

impl Glass {
    /// `None` for what is no glass.
    fn new(material: &Material) -> Option<Self> {
        let Bsdf::ThinDielectric {
            ior,
            transmittance,
            face,
        } = material.bsdf
        else {
            return None;
        };
        let [r, g, b] = material.rgb;
        Some(Self {
            ior,
            passes: [transmittance, r, g, b],
            face,
        })
    }

    /// Shares of the light that pass at an angle with this cosine.
    fn through(&self, cos: f32) -> [f32; 4] {
        let clear = clear(self.ior, cos);
        self.passes.map(|passes| match self.face {
            true => (passes * clear).sqrt(),
            false => passes * clear,
        })
    }
}

/// Share of unpolarised light that passes a pane which absorbs nothing: with r the reflectance of a face for one polarisation
/// (Fresnel), 1 − r passes the first, and of the sum over all reflections to and fro (1 − r)/(1 + r) the pane.
fn clear(ior: f32, cos: f32) -> f32 {
    let cos = cos.clamp(0.0, 1.0);
    // Snell, times the index: without the cancellation of 1 − sin², so that an index of 1 takes nothing at any angle.
    let inside = (ior * ior - 1.0 + cos * cos).sqrt();
    let share = |a: f32, b: f32| {
        let root = (a - b) / (a + b);
        let r = root * root;
        (1.0 - r) / (1.0 + r)
    };
    // An index of 1, along the pane: it is not crossed.
    if inside + cos <= 0.0 {
        return 0.0;
    }
    0.5 * (share(cos, inside) + share(ior * ior * cos, inside))
}

/// All glass of a scene.
#[derive(Debug)]
pub(crate) struct Panes {
    bvh: Bvh,
    /// Unit normals, one a triangle.
    normals: Vec<Vec3>,
    /// Glass of each triangle.
    glass: Vec<Glass>,
}

impl Panes {
    /// The panes of these triangles (render units) of these materials; `None` where there are none.
    ///
    /// # Errors
    /// [`RenderError::Stopped`].
    pub fn new(
        triangles: &[[Vec3; 3]],
        materials: &[&Material],
        stop: Stop,
    ) -> Result<Option<Self>, RenderError> {
        if triangles.is_empty() {
            return Ok(None);
        }
        let glass: Vec<Glass> = materials.iter().filter_map(|m| Glass::new(m)).collect();
        assert_eq!(triangles.len(), glass.len(), "a pane is of glass");
        let each = triangles.iter();
        Ok(Some(Self {
            bvh: Bvh::build_unless(triangles, stop)?,
            normals: each.map(|t| normal(t).unwrap_or_default()).collect(),
            glass,
        }))
    }

    /// Share of the laser's light that passes on the straight way from `a` to `b`.
    pub fn through(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> f32 {
        self.shares(stack, a, b)[0]
    }

    /// Shares of red, green and blue light that pass on the straight way from `a` to `b`.
    pub fn tint(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> [f32; 3] {
        let [_, r, g, b] = self.shares(stack, a, b);
        [r, g, b]
    }

    fn shares(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> [f32; 4] {
        let way = b - a;
        let mut all = [1.0; 4];
        self.bvh.deepen(stack);
        if !self.bvh.occluded(stack, a, way, 1.0) {
            return all;
        }
        let length = way.length();
        let mut met = std::mem::take(&mut stack.met);
        self.bvh.all(stack, (a, way, 1.0), &mut met);
        let mut last = f32::NEG_INFINITY;
        for &(t, id) in &met {
            let at = t * length;
            if at - last < SAME {
                continue;
            }
            last = at;
            let id = id as usize;
            let cos = self.normals[id].dot(way).abs() / length;
            let through = self.glass[id].through(cos);
            for (all, through) in all.iter_mut().zip(through) {
                *all *= through;
            }
        }
        stack.met = met;
        all
    }
}

#[cfg(test)]
#[path = "glass/tests.rs"]
mod tests;
