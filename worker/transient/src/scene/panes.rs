//! Thin glass. It is not a surface: light passes straight through it, and a straight
//! segment between two points carries the share of light that the panes on it transmit. So every
//! technique of the renderer stays the same, with that share as the visibility, and the sampling
//! densities do not change. Light that glass reflects has techniques of its own:
//! [`crate::paths::glass::technique`].
//!
//! The panes have a hierarchy of their own, separate from that of the surfaces, so that scenes
//! without glass have no extra cost.

use picofarm_scene::{Bsdf, Material, Vec3};

use crate::{
    api::{RenderError, Stop},
    scene::{
        bvh::{
            normal::normal,
            tree::{Bvh, Stack},
        },
        intersection::point,
    },
};

/// Length within which hits of glass on a ray count as one, render units: hits of two triangles at
/// a common edge, and of duplicate sheets.
const SAME: f32 = 1.0 / 65536.0;

/// The properties of a material's glass.
#[derive(Debug, Clone, Copy)]
struct Glass {
    ior: f32,
    /// Transmittance of a pane apart from reflection: at the laser's wavelength, and for red, green
    /// and blue.
    passes: [f32; 4],
    /// Whether it is one of a pane's two faces.
    face: bool,
}

impl Glass {
    /// Returns `None` if the material is not thin glass.
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

    /// Returns the transmitted shares of the light at an angle with this cosine.
    fn through(&self, cos: f32) -> [f32; 4] {
        let clear = clear(self.ior, cos);
        self.passes.map(|passes| match self.face {
            true => (passes * clear).sqrt(),
            false => passes * clear,
        })
    }

    /// Returns the reflected share of the laser's light at an angle with this cosine. If a pane has
    /// two faces, the front of each, on the side of its normal, reflects for both.
    fn reflects(&self, cos: f32, front: bool) -> f32 {
        match self.face && !front {
            true => 0.0,
            false => reflected(self.ior, self.passes[0], cos),
        }
    }
}

/// Returns the transmitted share of unpolarised light for a pane without absorption. Let r be the
/// reflectance of a face for one polarisation (Fresnel). The first face transmits 1 − r, and with
/// the sum over all internal reflections the pane transmits (1 − r)/(1 + r).
fn clear(ior: f32, cos: f32) -> f32 {
    let cos = cos.clamp(0.0, 1.0);
    // Snell's law times the index, without the cancellation of 1 − sin², so that an index of 1
    // removes nothing at any angle.
    let inside = (ior * ior - 1.0 + cos * cos).sqrt();
    let share = |a: f32, b: f32| {
        let root = (a - b) / (a + b);
        let r = root * root;
        (1.0 - r) / (1.0 + r)
    };
    // With an index of 1, a ray along the pane does not cross it.
    if inside + cos <= 0.0 {
        return 0.0;
    }
    0.5 * (share(cos, inside) + share(ior * ior * cos, inside))
}

/// Returns the reflected share of unpolarised light for a pane. A face of reflectance r for one
/// polarisation (Fresnel) reflects r. Of the light from the other face, 1 − r passes, or
/// (1 − r)/(1 + r) with all internal reflections, tinted twice.
fn reflected(ior: f32, tint: f32, cos: f32) -> f32 {
    let cos = cos.clamp(0.0, 1.0);
    let inside = (ior * ior - 1.0 + cos * cos).sqrt();
    if inside + cos <= 0.0 {
        return 0.0;
    }
    let share = |a: f32, b: f32| {
        let root = (a - b) / (a + b);
        let r = root * root;
        r + tint * tint * r * (1.0 - r) / (1.0 + r)
    };
    0.5 * (share(cos, inside) + share(ior * ior * cos, inside))
}

/// The crossing of a straight segment and a pane.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crossing {
    /// Index of the triangle of glass.
    pub pane: u32,
    /// Transmitted share of the laser's light.
    pub passes: f32,
    /// Reflected share.
    pub reflects: f32,
}

/// All glass of a scene.
#[derive(Debug)]
pub(crate) struct Panes {
    bvh: Bvh,
    /// Corners, render units.
    triangles: Vec<[Vec3; 3]>,
    /// Unit normals, one per triangle.
    normals: Vec<Vec3>,
    /// Glass of each triangle.
    glass: Vec<Glass>,
}

impl Panes {
    /// Creates the panes of these triangles (render units) of these materials; `None` if there are
    /// none.
    ///
    /// # Errors
    /// [`RenderError::Stopped`] if the render was stopped.
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
            triangles: triangles.to_vec(),
            normals: each.map(|t| normal(t).unwrap_or_default()).collect(),
            glass,
        }))
    }

    /// Returns the transmitted share of the laser's light on the straight segment from `a` to `b`.
    pub fn through(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> f32 {
        self.shares(stack, a, b)[0]
    }

    /// Like [`Panes::through`], from one point to many: calls `each` with the index of every
    /// segment that glass crosses, and its share.
    pub fn through_bundle(
        &self,
        stack: &mut Stack,
        from: Vec3,
        to: &[Vec3],
        mut each: impl FnMut(usize, f32),
    ) {
        self.bvh.deepen(stack);
        let mut crossed = std::mem::take(&mut stack.crossed);
        crossed.resize(to.len(), false);
        self.bvh.occluded_bundle(stack, from, to, &mut crossed);
        for (k, _) in crossed.iter().enumerate().filter(|(_, crossed)| **crossed) {
            let mut share = 1.0;
            self.across(stack, from, to[k] - from, |glass, _, along| {
                share *= glass.through(along.abs())[0];
            });
            each(k, share);
        }
        stack.crossed = crossed;
    }

    /// Returns the shares of red, green and blue light that are transmitted on the straight segment
    /// from `a` to `b`.
    pub fn tint(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> [f32; 3] {
        let [_, r, g, b] = self.shares(stack, a, b);
        [r, g, b]
    }

    /// Returns the corners and the unit normal of each triangle.
    pub fn triangles(&self) -> impl Iterator<Item = ([Vec3; 3], Vec3)> {
        let corners = self.triangles.iter().copied();
        corners.zip(self.normals.iter().copied())
    }

    /// Returns the share of light that a triangle reflects at normal incidence.
    pub fn reflectance(&self, pane: usize) -> f32 {
        self.glass[pane].reflects(1.0, true)
    }

    /// Returns the share that a triangle's front reflects at an angle with this cosine, never 0.
    pub fn weight(&self, pane: usize, cos: f32) -> f32 {
        self.glass[pane].reflects(cos, true).max(1e-3)
    }

    /// Returns whether a triangle's back reflects like its front.
    pub fn two_sided(&self, pane: usize) -> bool {
        !self.glass[pane].face
    }

    /// Returns the intersection of a triangle's plane and the line from `origin` along `direction`,
    /// and the unit normal facing the origin.
    pub fn point(&self, pane: u32, origin: Vec3, direction: Vec3) -> (Vec3, Vec3) {
        let n = self.normals[pane as usize];
        let p = point(&self.triangles[pane as usize], origin, direction);
        (p, if n.dot(direction) <= 0.0 { n } else { -n })
    }

    /// Writes the panes on the straight segment from `a` to `b` in order.
    pub fn crossings(&self, stack: &mut Stack, a: Vec3, b: Vec3, out: &mut Vec<Crossing>) {
        out.clear();
        let way = b - a;
        self.each(stack, a, way, |glass, pane, along| {
            let cos = along.abs();
            out.push(Crossing {
                pane,
                passes: glass.through(cos)[0],
                reflects: glass.reflects(cos, along <= 0.0),
            });
        });
    }

    fn shares(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> [f32; 4] {
        let mut all = [1.0; 4];
        self.each(stack, a, b - a, |glass, _, along| {
            let through = glass.through(along.abs());
            for (all, through) in all.iter_mut().zip(through) {
                *all *= through;
            }
        });
        all
    }

    /// Calls `each` for every pane on a segment, with its triangle and the component of the
    /// segment's direction along its normal.
    fn each(&self, stack: &mut Stack, a: Vec3, way: Vec3, each: impl FnMut(&Glass, u32, f32)) {
        self.bvh.deepen(stack);
        if self.bvh.occluded(stack, a, way, 1.0) {
            self.across(stack, a, way, each);
        }
    }

    /// Like [`Panes::each`], for a segment that glass is known to cross.
    fn across(
        &self,
        stack: &mut Stack,
        a: Vec3,
        way: Vec3,
        mut each: impl FnMut(&Glass, u32, f32),
    ) {
        let length = way.length();
        let mut met = std::mem::take(&mut stack.met);
        self.bvh.all(stack, a, way, 1.0, &mut met);
        let mut last = f32::NEG_INFINITY;
        for &(t, id) in &met {
            let distance = t * length;
            if distance - last < SAME {
                continue;
            }
            last = distance;
            let pane_index = id as usize;
            each(
                &self.glass[pane_index],
                id,
                self.normals[pane_index].dot(way) / length,
            );
        }
        stack.met = met;
    }
}

#[cfg(test)]
#[path = "panes/tests.rs"]
mod tests;
