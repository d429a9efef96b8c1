//! Converts Mitsuba's shapes to meshes in their own frame.

use std::collections::BTreeMap;

use crate::{
    Mesh, Vec3,
    import::{far, obj, ply, quoted, read_file},
};

use super::{Reader, node::Node, properties as p, serialized, transform::Matrix};

/// The number of facets of a tessellated sphere from pole to pole, and half of those around it.
const SPHERE_ROWS: u32 = 48;
/// The number of facets of a tessellated disk.
const DISK_SECTORS: u32 = 96;

/// Geometry without materials.
#[derive(Debug, Clone, Default)]
pub(super) struct Geometry {
    pub(super) positions: Vec<Vec3>,
    pub(super) uv: Vec<[f32; 2]>,
    pub(super) triangles: Vec<[u32; 3]>,
    /// The origin of `positions` in the file's coordinates. A mesh far from its origin is moved
    /// before it is rounded.
    pub(super) origin: [f64; 3],
    /// The notes, by key.
    pub(super) notes: BTreeMap<String, String>,
}

impl Geometry {
    /// Moves vertices back to the file's coordinates.
    pub(super) fn restore(&mut self) {
        if self.origin != [0.0; 3] {
            let origin = Vec3::from(self.origin.map(|x| x as f32));
            for p in &mut self.positions {
                *p += origin;
            }
            self.origin = [0.0; 3];
        }
    }

    fn vertex(&mut self, p: [f32; 3], uv: [f32; 2]) {
        self.positions.push(Vec3::from(p));
        self.uv.push(uv);
    }

    fn turned(mut self) -> Self {
        for t in &mut self.triangles {
            t.swap(1, 2);
        }
        self
    }

    /// Appends this geometry to a mesh; its facets have material `slot`.
    pub(super) fn append_to(&self, mesh: &mut Mesh, slot: u32, to_uv: &Matrix) {
        let base = mesh.positions.len();
        mesh.positions.extend(&self.positions);
        if !self.uv.is_empty() {
            mesh.uv.resize(base, [0.0; 2]);
            mesh.uv.extend(self.uv.iter().map(|uv| placed(to_uv, *uv)));
        }
        if !mesh.uv.is_empty() {
            mesh.uv.resize(mesh.positions.len(), [0.0; 2]);
        }
        let shift = |t: &[u32; 3]| t.map(|v| v + base as u32);
        mesh.triangles.extend(self.triangles.iter().map(shift));
        mesh.triangle_material
            .extend(self.triangles.iter().map(|_| slot));
    }
}

fn placed(to_uv: &Matrix, [u, v]: [f32; 2]) -> [f32; 2] {
    if *to_uv == Matrix::IDENTITY {
        return [u, v];
    }
    let (u, v) = (f64::from(u), f64::from(v));
    [0, 1].map(|r| {
        let m = to_uv.0[r];
        // Mitsuba uses the third column of a 3×3 as the shift, and the fourth of a 4×4.
        (m[0] * u + m[1] * v + m[2] + m[3]) as f32
    })
}

impl Reader<'_> {
    /// Returns a shape's geometry, and the transform that its own parameters add to `to_world`.
    pub(super) fn geometry(&mut self, node: &Node) -> Result<(Geometry, Matrix), String> {
        let mut place = Matrix::IDENTITY;
        let geometry = match node.kind.as_str() {
            "ply" | "obj" => {
                self.only(node, &p::MESH_FILE)?;
                self.file(node)?
            }
            "serialized" => {
                self.only(node, &p::SERIALIZED)?;
                self.file(node)?
            }
            "cylinder" => {
                self.only(node, &p::CYLINDER)?;
                self.note("cylinders", format!("have {DISK_SECTORS} flat sectors"));
                let ends = [("p0", [0.0; 3]), ("p1", [0.0, 0.0, 1.0])];
                let ends = ends.map(|(name, usual)| Ok(node.vector(name)?.unwrap_or(usual)));
                let [p0, p1]: [Result<[f64; 3], String>; 2] = ends;
                place = along(p0?, p1?, positive(node, "radius")?)
                    .ok_or_else(|| node.fail("p0 and p1: are the same point"))?;
                cylinder()
            }
            "rectangle" => {
                self.only(node, &p::PRIMITIVE)?;
                rectangle()
            }
            "cube" => {
                self.only(node, &p::PRIMITIVE)?;
                cube()
            }
            "disk" => {
                self.only(node, &p::PRIMITIVE)?;
                self.note("disks", format!("have {DISK_SECTORS} flat sectors"));
                disk()
            }
            "sphere" => {
                self.only(node, &p::SPHERE)?;
                let rows = SPHERE_ROWS;
                self.note(
                    "spheres",
                    format!("have {} by {rows} flat facets", 2 * rows),
                );
                let radius = positive(node, "radius")?;
                let centre = node.vector("center")?.unwrap_or([0.0; 3]);
                place = Matrix::translation(centre).after(&Matrix::scale([radius; 3]));
                sphere()
            }
            other => {
                return Err(node.fail(format!(
                    "shape {} is not supported; use ply, obj, serialized, rectangle, cube, sphere, disk or cylinder",
                    quoted(other)
                )));
            }
        };
        let turned = node.switch("flip_normals")?.unwrap_or(false);
        Ok((if turned { geometry.turned() } else { geometry }, place))
    }

    fn file(&mut self, node: &Node) -> Result<Geometry, String> {
        let filename = node
            .text("filename")?
            .ok_or_else(|| node.fail("needs a filename"))?;
        let path = self.named(node, filename)?;
        // In OBJ, v points upwards; in PLY, as in our meshes, downwards.
        let obj = node.kind == "obj";
        let flip = node.switch("flip_tex_coords")?.unwrap_or(obj);
        let index = node.number("shape_index")?.unwrap_or(0.0);
        if !(0.0..1e9).contains(&index) || index.fract() != 0.0 {
            return Err(node.fail("shape_index: expected a whole number from 0"));
        }
        let key = (path.clone(), index as usize);
        let mut geometry = match self.geometries.get(&key) {
            Some(known) => known.clone(),
            None => {
                let bytes = read_file(self.files, &path).map_err(|e| node.fail(e))?;
                let read = match node.kind.as_str() {
                    "obj" => read_obj(&bytes),
                    "serialized" => serialized::read(&bytes, key.1),
                    _ => read_ply(&bytes),
                };
                let geometry = read.map_err(|e| node.fail(format!("{}: {e}", path.display())))?;
                self.geometries.insert(key, geometry.clone());
                geometry
            }
        };
        for (key, note) in std::mem::take(&mut geometry.notes) {
            self.note(&key, note);
        }
        if flip {
            for uv in &mut geometry.uv {
                uv[1] = 1.0 - uv[1];
            }
        }
        Ok(geometry)
    }
}

fn read_ply(bytes: &[u8]) -> Result<Geometry, String> {
    let ply = ply::parse(bytes)?;
    let mut notes = ply.notes;
    if ply.colour.is_some() {
        let what = "ignored; materials' colours used".to_owned();
        notes.insert("vertex_colours".into(), what);
    }
    let (positions, origin) = far::local(&ply.positions);
    Ok(Geometry {
        positions,
        uv: ply.uv,
        triangles: ply.triangles,
        origin,
        notes,
    })
}

fn read_obj(bytes: &[u8]) -> Result<Geometry, String> {
    // Mitsuba uses the shape's material, never the OBJ's.
    let obj = obj::parse(bytes).map_err(|e| format!("is not readable OBJ: {e}"))?;
    let (positions, origin) = far::local(&obj.positions);
    Ok(Geometry {
        positions,
        uv: obj.uv,
        triangles: obj.triangles,
        origin,
        notes: obj.notes,
    })
}

fn rectangle() -> Geometry {
    let mut g = Geometry::default();
    for [u, v] in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0f32]] {
        g.vertex([2.0 * u - 1.0, 2.0 * v - 1.0, 0.0], [u, v]);
    }
    g.triangles = vec![[0, 1, 2], [0, 2, 3]];
    g
}

/// Returns the cube from −1 to 1, each face with the whole image.
fn cube() -> Geometry {
    const FACES: [[[f32; 3]; 4]; 6] = [
        [
            [1., -1., -1.],
            [1., -1., 1.],
            [-1., -1., 1.],
            [-1., -1., -1.],
        ],
        [[1., 1., -1.], [-1., 1., -1.], [-1., 1., 1.], [1., 1., 1.]],
        [[1., -1., -1.], [1., 1., -1.], [1., 1., 1.], [1., -1., 1.]],
        [[1., -1., 1.], [1., 1., 1.], [-1., 1., 1.], [-1., -1., 1.]],
        [
            [-1., -1., 1.],
            [-1., 1., 1.],
            [-1., 1., -1.],
            [-1., -1., -1.],
        ],
        [
            [1., 1., -1.],
            [1., -1., -1.],
            [-1., -1., -1.],
            [-1., 1., -1.],
        ],
    ];
    let mut g = Geometry::default();
    for face in FACES {
        let base = g.positions.len() as u32;
        for (p, uv) in face
            .into_iter()
            .zip([[0., 1.], [1., 1.], [1., 0.], [0., 0.]])
        {
            g.vertex(p, uv);
        }
        g.triangles.push([base, base + 1, base + 2]);
        g.triangles.push([base + 3, base, base + 2]);
    }
    g
}

/// Returns the unit disk that faces +z; u is the radius, v the angle.
fn disk() -> Geometry {
    let mut g = Geometry::default();
    for k in 0..=DISK_SECTORS {
        let v = k as f32 / DISK_SECTORS as f32;
        let (s, c) = libm::sincosf(std::f32::consts::TAU * v);
        g.vertex([0.0; 3], [0.0, v]);
        g.vertex([c, s, 0.0], [1.0, v]);
        if k > 0 {
            g.triangles.push([2 * k - 2, 2 * k - 1, 2 * k + 1]);
        }
    }
    g
}

fn positive(node: &Node, name: &str) -> Result<f64, String> {
    let number = node.number(name)?.unwrap_or(1.0);
    match number.partial_cmp(&0.0) {
        Some(std::cmp::Ordering::Greater) => Ok(number),
        _ => Err(node.fail(format!("{name}: must be positive"))),
    }
}

/// Returns the map from the unit cylinder to the one between two points, or `None` if they are the
/// same.
fn along(p0: [f64; 3], p1: [f64; 3], radius: f64) -> Option<Matrix> {
    let axis = [0, 1, 2].map(|k: usize| p1[k] - p0[k]);
    let length = axis.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
        return None;
    }
    let z = axis.map(|x| x / length);
    // Any direction across the axis will do.
    let up = match z[0].abs() < 0.9 {
        true => [1.0, 0.0, 0.0],
        false => [0.0, 1.0, 0.0],
    };
    let turned = Matrix::look_at([0.0; 3], z, up).ok()?;
    let scaled = turned.after(&Matrix::scale([radius, radius, length]));
    Some(Matrix::translation(p0).after(&scaled))
}

/// Returns the open unit cylinder from z = 0 to 1, facing outwards; u is the angle, v the height.
fn cylinder() -> Geometry {
    let mut g = Geometry::default();
    for k in 0..=DISK_SECTORS {
        let u = k as f32 / DISK_SECTORS as f32;
        let (s, c) = libm::sincosf(std::f32::consts::TAU * u);
        g.vertex([c, s, 0.0], [u, 0.0]);
        g.vertex([c, s, 1.0], [u, 1.0]);
        if k > 0 {
            let base = 2 * k - 2;
            g.triangles.push([base, base + 2, base + 3]);
            g.triangles.push([base, base + 3, base + 1]);
        }
    }
    g
}

/// Returns the unit sphere with its poles on z; u is the azimuth, v the polar angle. It is closed:
/// each pole is a single position, and the positions at u = 1 are those at u = 0.
fn sphere() -> Geometry {
    let (rows, columns) = (SPHERE_ROWS, 2 * SPHERE_ROWS);
    let mut g = Geometry::default();
    for r in 0..=rows {
        let v = r as f32 / rows as f32;
        let (flat, z) = match r == rows {
            true => (0.0, -1.0),
            false => libm::sincosf(std::f32::consts::PI * v),
        };
        for c in 0..=columns {
            let turn = (c % columns) as f32 / columns as f32;
            let (y, x) = libm::sincosf(std::f32::consts::TAU * turn);
            g.vertex([flat * x, flat * y, z], [c as f32 / columns as f32, v]);
        }
    }
    let at = |r: u32, c: u32| r * (columns + 1) + c;
    for r in 0..rows {
        for c in 0..columns {
            let [a, b, d, e] = [at(r, c), at(r + 1, c), at(r + 1, c + 1), at(r, c + 1)];
            if r + 1 < rows {
                g.triangles.push([a, b, d]);
            }
            if r > 0 {
                g.triangles.push([a, d, e]);
            }
        }
    }
    g
}
