//! PLY meshes: ascii and binary in either byte order, faces with any number of corners, texture
//! coordinates, and colours as their mean.

mod body;
mod header;

use std::{collections::BTreeMap, path::Path, sync::Arc};

use crate::{Affine, Material, Mesh, Object, Provenance, SceneError};

use super::{ImportOptions, complete::Draft, far, format_error, polygon::Triangulation};
use body::{Body, Row};
use header::{Element, Number};

/// The linear albedo of a mesh without colours.
const GREY: f32 = 0.5;
/// Elements with geometry that cannot be read. They are refused, so that no geometry is lost
/// unnoticed.
const UNREAD_SURFACES: [&str; 2] = ["tristrips", "range_grid"];

/// The content of a PLY file.
#[derive(Debug, Default)]
pub(super) struct Ply {
    /// The positions as in the file.
    pub(super) positions: Vec<[f64; 3]>,
    /// Texture coordinates, one a vertex, or none.
    pub(super) uv: Vec<[f32; 2]>,
    pub(super) triangles: Vec<[u32; 3]>,
    /// The mean linear colour of the vertices, or else of the faces.
    pub(super) colour: Option<[f32; 3]>,
    /// The notes on changes and omissions, by key.
    pub(super) notes: BTreeMap<String, String>,
}

/// The faces as in the file.
#[derive(Default)]
struct Polygons {
    corners: Vec<u32>,
    /// The number of corners of each face.
    lengths: Vec<usize>,
}

/// Returns whether a file starts like PLY.
pub(super) fn is_ply(bytes: &[u8]) -> bool {
    bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r")
}

/// Reads a PLY file as a scene of one object, without camera and laser.
pub(super) fn read(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
) -> Result<Draft, SceneError> {
    let ply = parse(bytes).map_err(|what| format_error(path, what))?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    let mut notes: BTreeMap<String, String> = ply
        .notes
        .iter()
        .map(|(key, note)| (format!("import.{key}"), note.clone()))
        .collect();
    if ply.colour.is_some() {
        notes.insert(
            "import.colours".into(),
            "replaced by their mean over the mesh".into(),
        );
    }
    let mut origin = [0.0; 3];
    if options.camera.is_none()
        && let Some((centre, size)) = far::centre(&ply.positions)
        && far::is_lossy(centre, size)
    {
        origin = centre;
        notes.insert("import.origin".into(), far::note(centre));
    }
    let mesh = Mesh {
        name: name.clone().into_owned(),
        triangle_material: vec![0; ply.triangles.len()],
        positions: far::relative(&ply.positions, origin),
        uv: ply.uv,
        triangles: ply.triangles,
        materials: vec![Material::diffuse("ply", ply.colour.unwrap_or([GREY; 3]))],
    };
    Ok(Draft {
        name: name.clone().into_owned(),
        objects: vec![Object {
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label: 0,
            name: name.into_owned(),
        }],
        labels: vec!["unlabelled".into()],
        cameras: Vec::new(),
        laser: None,
        has_unit: false,
        provenance: Provenance {
            source: "ply".into(),
            notes,
            ..Provenance::default()
        },
    })
}

/// Parses a whole file. The message names the element and quotes nothing, because the file may have
/// another format.
pub(super) fn parse(bytes: &[u8]) -> Result<Ply, String> {
    if !is_ply(bytes) {
        return Err("is not PLY: its first line is not `ply`".into());
    }
    let (encoding, elements, start) = header::parse(bytes)?;
    let mut body = Body::new(encoding, &bytes[start..]);
    let mut ply = Ply::default();
    let mut polygons = Polygons::default();
    let mut ignored = Vec::new();
    for element in &elements {
        let mut colour = Mean::default();
        match element.name.as_str() {
            "vertex" => read_vertices(&mut body, element, &mut ply, &mut colour)?,
            "face" => read_faces(&mut body, element, (&mut polygons, &mut ply), &mut colour)?,
            name => {
                if UNREAD_SURFACES.contains(&name) && element.count > 0 {
                    return Err(format!(
                        "element {name}: is not supported; export the mesh with element face"
                    ));
                }
                ignored.push(name);
                body.rows(element, |_| Ok(()))?;
            }
        }
        ply.colour = ply.colour.or(colour.finish());
    }
    let left = body.left_over()?;
    if left > 0 {
        ply.note(
            "trailing_bytes",
            format!("{left} after the last row ignored"),
        );
    }
    if !ignored.is_empty() {
        ply.note("elements", format!("ignored: {}", ignored.join(", ")));
    }
    ply.triangulate(&polygons)?;
    if ply.triangles.is_empty() {
        return Err("element face: no triangles; export a mesh with faces (no point cloud)".into());
    }
    ply.drop_stray_vertices();
    Ok(ply)
}

impl Ply {
    fn note(&mut self, key: &str, what: impl Into<String>) {
        self.notes.insert(key.into(), what.into());
    }

    fn triangulate(&mut self, polygons: &Polygons) -> Result<(), String> {
        let (mut split, mut skipped) = (Triangulation::default(), 0);
        let (mut places, mut parts) = (Vec::new(), Vec::new());
        let mut rest = polygons.corners.as_slice();
        for (k, &length) in polygons.lengths.iter().enumerate() {
            let (corners, after) = rest.split_at(length);
            rest = after;
            if let Some(v) = corners
                .iter()
                .find(|v| **v as usize >= self.positions.len())
            {
                return Err(format!(
                    "element face row {k}: index {v} points past {} vertices",
                    self.positions.len()
                ));
            }
            if length < 3 {
                skipped += 1;
            }
            let finite = |v: u32| self.positions[v as usize].iter().all(|x| x.is_finite());
            if let Some(v) = corners.iter().find(|v| !finite(**v)) {
                return Err(format!(
                    "element face row {k}: vertex {v} is not finite; repair the mesh"
                ));
            }
            places.clear();
            places.extend(corners.iter().map(|v| self.positions[*v as usize]));
            parts.clear();
            split
                .split(&places, &mut parts)
                .map_err(|what| format!("element face row {k}: {what}"))?;
            let triangle = |t: &[u32; 3]| t.map(|c| corners[c as usize]);
            self.triangles.extend(parts.iter().map(triangle));
        }
        if skipped > 0 {
            self.note(
                "faces",
                format!("{skipped} with fewer than three corners left out"),
            );
        }
        if let Some(note) = split.note() {
            self.note("polygons", note);
        }
        Ok(())
    }

    /// Removes vertices without a face, which are not part of the surface and must not influence
    /// the position of a camera.
    fn drop_stray_vertices(&mut self) {
        let mut places = vec![u32::MAX; self.positions.len()];
        for v in self.triangles.iter().flatten() {
            places[*v as usize] = 0;
        }
        let stray = places.iter().filter(|p| **p == u32::MAX).count();
        if stray == 0 {
            return;
        }
        for (next, place) in (0..).zip(places.iter_mut().filter(|p| **p == 0)) {
            *place = next;
        }
        let mut k = places.iter();
        self.positions
            .retain(|_| k.next().is_some_and(|p| *p != u32::MAX));
        let mut k = places.iter();
        self.uv.retain(|_| k.next().is_some_and(|p| *p != u32::MAX));
        for t in &mut self.triangles {
            *t = t.map(|v| places[v as usize]);
        }
        self.note(
            "stray_vertices",
            format!("{stray} that no face has left out"),
        );
    }
}

fn read_vertices(
    body: &mut Body<'_>,
    element: &Element,
    ply: &mut Ply,
    colour: &mut Mean,
) -> Result<(), String> {
    let needs = |name: &str| match element.find(&[name]) {
        Some(k) if element.properties[k].length.is_none() => Ok(k),
        Some(_) => Err(format!(
            "element vertex: property {name} is a list, expected a number"
        )),
        None => Err(format!("element vertex: has no property {name}")),
    };
    let place = [needs("x")?, needs("y")?, needs("z")?];
    let number = |names: &[&str]| {
        let k = element.find(names)?;
        element.properties[k].length.is_none().then_some(k)
    };
    let coordinates = number(&["u", "s", "texture_u"]).zip(number(&["v", "t", "texture_v"]));
    let channels = Channels::of(element);
    body.rows(element, |row| {
        ply.positions.push(place.map(|k| row.first(k)));
        if let Some((u, v)) = coordinates {
            ply.uv.push([row.first(u) as f32, row.first(v) as f32]);
        }
        channels.add(row, colour);
        Ok(())
    })
}

fn read_faces(
    body: &mut Body<'_>,
    element: &Element,
    (polygons, ply): (&mut Polygons, &mut Ply),
    colour: &mut Mean,
) -> Result<(), String> {
    let list = element.find(&["vertex_indices", "vertex_index"]);
    let list = list.filter(|k| element.properties[*k].length.is_some());
    let Some(list) = list else {
        return Err("element face: has no list vertex_indices; export the mesh with faces".into());
    };
    if element.find(&["texcoord", "texnumber"]).is_some() {
        ply.note(
            "face_textures",
            "ignored: texture coordinates are read by vertex only",
        );
    }
    let channels = Channels::of(element);
    body.rows(element, |row| {
        let corners = row.all(list);
        for &v in corners {
            if v.fract() != 0.0 || !(0.0..=f64::from(u32::MAX)).contains(&v) {
                return Err(format!("index {v} is no vertex"));
            }
            polygons.corners.push(v as u32);
        }
        polygons.lengths.push(corners.len());
        channels.add(row, colour);
        Ok(())
    })
}

/// The properties of an element that contain its colour: bytes are sRGB, floats linear.
struct Channels(Option<([usize; 3], bool)>);

impl Channels {
    fn of(element: &Element) -> Self {
        let find = |names: &[&str]| {
            let k = element.find(names)?;
            element.properties[k].length.is_none().then_some(k)
        };
        let rgb = find(&["red", "r", "diffuse_red"])
            .zip(find(&["green", "g", "diffuse_green"]))
            .zip(find(&["blue", "b", "diffuse_blue"]));
        Self(rgb.map(|((r, g), b)| {
            let bytes = element.properties[r].number == Number::U8;
            ([r, g, b], bytes)
        }))
    }

    fn add(&self, row: &Row, mean: &mut Mean) {
        if let Some((channels, bytes)) = self.0 {
            mean.add(channels.map(|k| {
                let value = row.first(k);
                if bytes {
                    f64::from(crate::texture::linear(value as u8))
                } else {
                    value.clamp(0.0, 1.0)
                }
            }));
        }
    }
}

#[derive(Default)]
struct Mean {
    sum: [f64; 3],
    count: u64,
}

impl Mean {
    fn add(&mut self, colour: [f64; 3]) {
        for (s, c) in self.sum.iter_mut().zip(colour) {
            *s += c;
        }
        self.count += 1;
    }

    fn finish(&self) -> Option<[f32; 3]> {
        (self.count > 0).then(|| self.sum.map(|s| (s / self.count as f64) as f32))
    }
}
