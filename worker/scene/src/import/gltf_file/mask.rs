//! Masks (`alphaMode` MASK) that cut holes into surfaces. Triangles at the edge of a hole are
//! divided down to the texels of the mask, and those in the hole are removed.

use std::collections::BTreeMap;

use gltf::material::AlphaMode;

use crate::{Mesh, SceneError, Wrap, import::format_error, import::image};

use super::{Walk, material::albedo_texture};

/// The greatest number of divisions of a triangle.
const MAX_DIVISIONS: u32 = 10;
/// The greatest number of triangles that the masks of a file add. Beyond it, triangles are kept or
/// removed as a whole.
const MAX_ADDED: usize = 4_000_000;
/// The greatest number of texels that are looked at before a triangle is divided.
const MAX_SCANNED: i64 = 1 << 16;

/// The holes of a material.
pub(super) enum Mask {
    /// The surface has no hole.
    Whole,
    /// The surface is one hole.
    Hole,
    Image(Cutout),
}

/// The texels of a mask.
pub(super) struct Cutout {
    width: i64,
    height: i64,
    solid: Vec<bool>,
    wrap: Wrap,
}

impl Cutout {
    /// Returns whether there is surface at texel coordinates.
    fn is_solid(&self, x: i64, y: i64) -> bool {
        let place = |k: i64, n: i64| match self.wrap {
            Wrap::Repeat => k.rem_euclid(n),
            Wrap::Mirror => {
                let k = k.rem_euclid(2 * n);
                k.min(2 * n - 1 - k)
            }
            Wrap::Clamp => k.clamp(0, n - 1),
        };
        self.solid[(place(y, self.height) * self.width + place(x, self.width)) as usize]
    }

    /// Returns whether all texels of a box are surface (true) or hole (false), or `None` if they
    /// differ or are too many.
    fn uniform(&self, [lo, hi]: [[i64; 2]; 2]) -> Option<bool> {
        let size = [0, 1].map(|k: usize| hi[k].saturating_sub(lo[k]).saturating_add(1));
        if size[0].checked_mul(size[1]).is_none_or(|n| n > MAX_SCANNED) {
            return None;
        }
        let first = self.is_solid(lo[0], lo[1]);
        let all = (lo[1]..=hi[1]).all(|y| (lo[0]..=hi[0]).all(|x| self.is_solid(x, y) == first));
        all.then_some(first)
    }
}

/// The work on one primitive.
pub(super) struct Cut<'m> {
    pub(super) mesh: &'m mut Mesh,
    pub(super) mask: &'m Cutout,
    /// The vertices in the middle of divided edges.
    pub(super) middles: BTreeMap<[u32; 2], u32>,
    /// The number of triangles that may still be added.
    pub(super) left: usize,
}

impl Cut<'_> {
    /// Appends what remains of a triangle.
    pub(super) fn triangle(&mut self, t: [u32; 3], out: &mut Vec<[u32; 3]>) {
        self.divide(t, 0, out);
    }

    fn divide(&mut self, t: [u32; 3], divisions: u32, out: &mut Vec<[u32; 3]>) {
        let size = [self.mask.width as f32, self.mask.height as f32];
        let corners = t.map(|v| {
            let uv = self.mesh.uv[v as usize];
            [uv[0] * size[0], uv[1] * size[1]]
        });
        let texel = |x: f32| x.floor().clamp(-1e9, 1e9) as i64;
        let bound = |pick: fn(f32, f32) -> f32, k: usize| {
            texel(pick(pick(corners[0][k], corners[1][k]), corners[2][k]))
        };
        let lo = [bound(f32::min, 0), bound(f32::min, 1)];
        let hi = [bound(f32::max, 0), bound(f32::max, 1)];
        let fine = (0..2).all(|k| hi[k] - lo[k] <= 1);
        match self.mask.uniform([lo, hi]) {
            Some(true) => out.push(t),
            Some(false) => {}
            None if fine || divisions == MAX_DIVISIONS || self.left < 3 => {
                let centre = [0, 1]
                    .map(|k: usize| texel((corners[0][k] + corners[1][k] + corners[2][k]) / 3.0));
                if self.mask.is_solid(centre[0], centre[1]) {
                    out.push(t);
                }
            }
            None => {
                self.left -= 3;
                let [a, b, c] = t;
                let [ab, bc, ca] = [self.middle(a, b), self.middle(b, c), self.middle(c, a)];
                for part in [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]] {
                    self.divide(part, divisions + 1, out);
                }
            }
        }
    }

    fn middle(&mut self, a: u32, b: u32) -> u32 {
        let next = self.mesh.positions.len() as u32;
        let vertex = *self.middles.entry([a.min(b), a.max(b)]).or_insert(next);
        if vertex == next {
            let [p, q] = [a, b].map(|v| self.mesh.positions[v as usize]);
            let [s, t] = [a, b].map(|v| self.mesh.uv[v as usize]);
            self.mesh.positions.push((p + q) * 0.5);
            self.mesh
                .uv
                .push([0.5 * (s[0] + t[0]), 0.5 * (s[1] + t[1])]);
        }
        vertex
    }
}

impl Walk<'_> {
    /// Returns the holes of a material. `has_uv` is true if the mesh has its texture coordinates.
    pub(super) fn mask(
        &mut self,
        file: &gltf::Material<'_>,
        has_uv: bool,
    ) -> Result<Mask, SceneError> {
        if !self.strict || file.alpha_mode() != AlphaMode::Mask {
            return Ok(Mask::Whole);
        }
        let field = format!("materials[{}]", file.index().unwrap_or(0));
        let [.., factor] = match file.pbr_specular_glossiness() {
            Some(pbr) => pbr.diffuse_factor(),
            None => file.pbr_metallic_roughness().base_color_factor(),
        };
        let cutoff = file.alpha_cutoff().unwrap_or(0.5);
        let texture = albedo_texture(file).map(|info| info.texture());
        let alpha = match texture.filter(|t| has_uv && !self.is_sourceless(t)) {
            None => None,
            Some(texture) => {
                let (bytes, _) = self.image_bytes(&texture, &field)?;
                let alpha = image::alpha(&bytes)
                    .map_err(|what| format_error(self.path, format!("{field}: {what}")))?;
                alpha.map(|alpha| (alpha, super::material::wrap(&texture)))
            }
        };
        let Some((((width, height), texels), wrap)) = alpha else {
            return Ok(match factor >= cutoff {
                true => Mask::Whole,
                false => Mask::Hole,
            });
        };
        let solid: Vec<bool> = texels
            .iter()
            .map(|a| factor * f32::from(*a) / 255.0 >= cutoff)
            .collect();
        match solid.iter().all(|s| *s) {
            true => Ok(Mask::Whole),
            false => Ok(Mask::Image(Cutout {
                width: i64::from(width),
                height: i64::from(height),
                solid,
                wrap,
            })),
        }
    }

    /// Removes the holes of a primitive. New vertices are appended to the mesh.
    pub(super) fn without_holes(
        &mut self,
        mesh: &mut Mesh,
        triangles: Vec<[u32; 3]>,
        mask: &Mask,
    ) -> Vec<[u32; 3]> {
        let mask = match mask {
            Mask::Whole => return triangles,
            Mask::Hole => {
                self.note("masks", "surfaces that are all hole left out");
                return Vec::new();
            }
            Mask::Image(mask) => mask,
        };
        let mut left = Vec::new();
        let mut cut = Cut {
            mesh,
            mask,
            middles: BTreeMap::new(),
            left: MAX_ADDED.saturating_sub(self.cut_triangles),
        };
        let before = cut.left;
        for triangle in triangles {
            cut.triangle(triangle, &mut left);
        }
        self.cut_triangles += before - cut.left;
        let what = match cut.left < 3 {
            true => "holes are cut in part: the masks are too fine for the limit of triangles",
            false => "holes are cut at the texels of their masks",
        };
        self.note("masks", what);
        left
    }
}
