//! The meshes of a glTF file: their primitives over one vertex list, with texture coordinates.

use std::collections::BTreeMap;

use gltf::{
    Accessor, Semantic,
    accessor::{DataType, Dimensions},
    mesh::Mode,
};

use crate::{Mesh, SceneError, Vec3, import::format_error};

use super::{Walk, deform::Deformation, material::Coordinates};

/// The greatest number of vertices and corners that one file may place in its meshes, including
/// rows of spectra. The limit is necessary because accessors and materials can be used many times.
pub(super) const MAX_CORNERS: usize = 1 << 28;

/// Colours of vertices with a smaller difference are the same.
const SAME_COLOUR: f32 = 0.5 / 255.0;

/// The key by which primitives share vertices: accessor of the positions, that of the texture
/// coordinates, and the transform of the latter.
type VertexKey = (usize, Option<usize>, [u32; 5]);

impl Walk<'_> {
    /// Returns a mesh's triangles over one vertex list, or `None` (with a note) if it has only
    /// lines or points.
    pub(super) fn mesh(
        &mut self,
        file: &gltf::Mesh<'_>,
        deformation: &Deformation,
    ) -> Result<Option<Mesh>, SceneError> {
        let path = self.path;
        let mut mesh = Mesh {
            name: file.name().unwrap_or("mesh").to_owned(),
            ..Mesh::default()
        };
        let mut vertex_base: BTreeMap<VertexKey, u32> = BTreeMap::new();
        let mut material_index: BTreeMap<(Option<usize>, bool, [u32; 3]), u32> = BTreeMap::new();
        for primitive in file.primitives() {
            let at = format!("meshes[{}].primitives[{}]", file.index(), primitive.index());
            let fail = |what: String| format_error(path, format!("{at}: {what}"));
            if matches!(
                primitive.mode(),
                Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip
            ) {
                if primitive.mode() == Mode::Points {
                    self.points = true;
                }
                self.note("dropped", "points and lines");
                continue;
            }
            let Some(accessor) = primitive.get(&Semantic::Positions) else {
                return Err(fail(
                    "has no POSITION; export the mesh with its vertices".into(),
                ));
            };
            if primitive.morph_targets().len() > 0 {
                self.note("morphs", "at their default weights");
            }
            self.buffers
                .check(&accessor, Dimensions::Vec3, &[DataType::F32])
                .map_err(fail)?;
            if let Some(indices) = primitive.indices() {
                let types = [DataType::U8, DataType::U16, DataType::U32];
                self.buffers
                    .check(&indices, Dimensions::Scalar, &types)
                    .map_err(fail)?;
            }
            let corners = primitive.indices().map_or(0, |i| i.count());
            self.corners += accessor.count().max(corners);
            if self.corners > MAX_CORNERS {
                return Err(fail(format!(
                    "more than {MAX_CORNERS} vertices in all; split the scene"
                )));
            }
            let material = primitive.material();
            let coordinates = self.coordinates(&material);
            let uv_accessor = primitive.get(&Semantic::TexCoords(coordinates.set));
            if let Some(uv) = &uv_accessor {
                self.check_uv(uv, accessor.count()).map_err(fail)?;
            }
            let tint = self.vertex_colour(&primitive, accessor.count(), &at)?;
            let look = (
                material.index(),
                uv_accessor.is_some(),
                tint.map(f32::to_bits),
            );
            let slot = match material_index.get(&look) {
                Some(&slot) => slot,
                None => {
                    let read = self.material(&material, uv_accessor.is_some(), tint)?;
                    self.corners += read.spectrum.len();
                    mesh.materials.push(read);
                    let slot = mesh.materials.len() as u32 - 1;
                    material_index.insert(look, slot);
                    slot
                }
            };
            let reader = primitive.reader(|b| self.buffers.get(&b));
            let key = (
                accessor.index(),
                uv_accessor.as_ref().map(Accessor::index),
                coordinates.bits(),
            );
            // Deformed vertices depend on more than their accessor.
            let known = vertex_base.get(&key).filter(|_| deformation.is_none());
            let base = match known {
                Some(&base) => base,
                None => {
                    let base = mesh.positions.len();
                    let read = reader.read_positions().into_iter().flatten();
                    mesh.positions.extend(read.map(Vec3::from));
                    if !deformation.is_none() {
                        let positions = &mut mesh.positions[base..];
                        self.deformed(&primitive, positions, deformation, &at)?;
                    }
                    if let Some(uv) = reader.read_tex_coords(coordinates.set) {
                        mesh.uv.resize(base, [0.0; 2]);
                        mesh.uv
                            .extend(uv.into_f32().map(|uv| coordinates.placed(uv)));
                    }
                    if !mesh.uv.is_empty() {
                        mesh.uv.resize(mesh.positions.len(), [0.0; 2]);
                    }
                    vertex_base.insert(key, base as u32);
                    base as u32
                }
            };
            let corners: Vec<u32> = match reader.read_indices() {
                Some(indices) => indices.into_u32().collect(),
                None => (0..accessor.count() as u32).collect(),
            };
            if let Some(&v) = corners.iter().find(|&&v| v as usize >= accessor.count()) {
                return Err(fail(format!(
                    "index {v} points past {} vertices",
                    accessor.count()
                )));
            }
            let mut triangles = triangles(&corners, primitive.mode());
            triangles.iter_mut().flatten().for_each(|v| *v += base);
            let mask = self.mask(&material, uv_accessor.is_some())?;
            let before = mesh.positions.len();
            let triangles = self.without_holes(&mut mesh, triangles, &mask);
            self.corners += mesh.positions.len() - before;
            mesh.triangle_material
                .extend(triangles.iter().map(|_| slot));
            mesh.triangles.extend(triangles);
        }
        Ok((!mesh.triangles.is_empty()).then_some(mesh))
    }

    /// Returns the mean colour of a primitive's vertices, which multiplies its material's colour.
    fn vertex_colour(
        &mut self,
        primitive: &gltf::Primitive<'_>,
        vertices: usize,
        at: &str,
    ) -> Result<[f32; 3], SceneError> {
        const WHITE: [f32; 3] = [1.0; 3];
        let Some(accessor) = primitive.get(&Semantic::Colors(0)) else {
            return Ok(WHITE);
        };
        if !self.strict {
            self.note("vertex_colours", "ignored; materials' colours used");
            return Ok(WHITE);
        }
        let fail = |what: String| format_error(self.path, format!("{at}.COLOR_0: {what}"));
        let types = [DataType::F32, DataType::U8, DataType::U16];
        let dimensions = match accessor.dimensions() {
            Dimensions::Vec3 => Dimensions::Vec3,
            _ => Dimensions::Vec4,
        };
        self.buffers
            .check(&accessor, dimensions, &types)
            .map_err(fail)?;
        if accessor.count() != vertices {
            return Err(fail(format!(
                "{} colours for {vertices} vertices",
                accessor.count()
            )));
        }
        let reader = primitive.reader(|b| self.buffers.get(&b));
        let Some(colours) = reader.read_colors(0) else {
            return Ok(WHITE);
        };
        let (mut sum, mut count) = ([0.0f64; 3], 0u32);
        let mut first = None;
        let mut differ = false;
        for colour in colours.into_rgb_f32() {
            if !colour.iter().all(|c| c.is_finite()) {
                return Err(fail("a colour is not finite; export again".into()));
            }
            let colour = colour.map(|c| c.clamp(0.0, 1.0));
            let known = *first.get_or_insert(colour);
            differ |= (0..3).any(|k| (colour[k] - known[k]).abs() > SAME_COLOUR);
            (0..3).for_each(|k| sum[k] += f64::from(colour[k]));
            count += 1;
        }
        if !differ {
            return Ok(first.unwrap_or(WHITE));
        }
        self.note(
            "vertex_colours",
            "replaced by their mean over each part of a mesh",
        );
        Ok(sum.map(|s| (s / f64::from(count)) as f32))
    }

    fn check_uv(&self, uv: &Accessor<'_>, vertices: usize) -> Result<(), String> {
        let types = [DataType::F32, DataType::U8, DataType::U16];
        self.buffers.check(uv, Dimensions::Vec2, &types)?;
        if uv.count() != vertices {
            return Err(format!(
                "accessors[{}]: {} texture coordinates for {vertices} vertices",
                uv.index(),
                uv.count()
            ));
        }
        Ok(())
    }
}

impl Coordinates {
    /// Applies KHR_texture_transform to a point of texture space: scaling, rotation, translation.
    fn placed(&self, [u, v]: [f32; 2]) -> [f32; 2] {
        let Some((offset, rotation, scale)) = self.transform else {
            return [u, v];
        };
        let (s, c) = (libm::sinf(rotation), libm::cosf(rotation));
        let (u, v) = (u * scale[0], v * scale[1]);
        [offset[0] + c * u + s * v, offset[1] - s * u + c * v]
    }

    fn bits(&self) -> [u32; 5] {
        self.transform.map_or([0; 5], |(o, r, s)| {
            [o[0], o[1], r, s[0], s[1]].map(f32::to_bits)
        })
    }
}

/// Converts corners to triangles: lists, strips (with every second one reversed) and fans.
fn triangles(corners: &[u32], mode: Mode) -> Vec<[u32; 3]> {
    match mode {
        Mode::TriangleStrip => corners
            .windows(3)
            .enumerate()
            .map(|(k, w)| {
                if k % 2 == 0 {
                    [w[0], w[1], w[2]]
                } else {
                    [w[1], w[0], w[2]]
                }
            })
            .collect(),
        Mode::TriangleFan => corners
            .get(1..)
            .unwrap_or_default()
            .windows(2)
            .map(|w| [corners[0], w[0], w[1]])
            .collect(),
        _ => corners
            .chunks_exact(3)
            .map(|t| [t[0], t[1], t[2]])
            .collect(),
    }
}
