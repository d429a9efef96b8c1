//! PLY meshes: ascii and binary of either byte order, faces of any number of corners, texture
//! coordinates; colours as their mean.

mod header;

use std::{collections::BTreeMap, path::Path, sync::Arc};

use crate::{
    Affine, Camera, Intrinsics, Material, Mesh, Object, Provenance, Scene, SceneError, Vec3,
};

use super::{ImportOptions, format_error};
use header::{Element, Encoding, Number};

/// Linear albedo of a mesh without colours.
const GREY: f32 = 0.5;
/// Image size and field of view of a camera that frames a mesh.
const FRAME_PIXELS: u32 = 256;
const FRAME_FOV_DEG: f32 = 60.0;

/// What a PLY file holds.
#[derive(Debug, Default)]
pub(super) struct Ply {
    pub(super) positions: Vec<Vec3>,
    /// One a vertex, or none.
    pub(super) uv: Vec<[f32; 2]>,
    pub(super) triangles: Vec<[u32; 3]>,
    /// Mean linear colour of the vertices, or else of the faces.
    pub(super) colour: Option<[f32; 3]>,
    /// Faces with fewer than three corners.
    pub(super) skipped: usize,
}

/// True for the first bytes of a PLY file.
pub(super) fn is_ply(bytes: &[u8]) -> bool {
    bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r")
}

/// A PLY file as a scene of one object: it has no camera and no laser, so `options` must help.
pub(super) fn read(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
) -> Result<Scene, SceneError> {
    let ply = parse(bytes).map_err(|what| format_error(path, what))?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    let mut notes = ply.notes();
    let mesh = Mesh {
        name: name.clone().into_owned(),
        triangle_material: vec![0; ply.triangles.len()],
        positions: ply.positions,
        uv: ply.uv,
        triangles: ply.triangles,
        materials: vec![Material::diffuse("ply", ply.colour.unwrap_or([GREY; 3]))],
    };
    let camera = options
        .camera
        .or_else(|| options.frame.then(|| frame(&mesh))?);
    let (Some(camera), Some(aim)) = (camera, &options.laser) else {
        return Err(format_error(
            path,
            "is a mesh without camera and laser: place it in a glTF or Mitsuba scene, or let \
             `picofarm scene export FILE --frame --out scene.glb` put both in front of it",
        ));
    };
    notes.insert("import.units".into(), "not stated; metres assumed".into());
    Ok(Scene {
        name: name.clone().into_owned(),
        objects: vec![Object {
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label: 0,
            name: name.into_owned(),
        }],
        labels: vec!["unlabelled".into()],
        camera,
        laser: aim.laser(&camera),
        provenance: Provenance {
            source: "ply".into(),
            notes,
            ..Provenance::default()
        },
    })
}

impl Ply {
    /// What was changed or left out.
    pub(super) fn notes(&self) -> BTreeMap<String, String> {
        let mut notes = BTreeMap::new();
        if self.colour.is_some() {
            notes.insert(
                "import.colours".into(),
                "replaced by their mean over the mesh".into(),
            );
        }
        if self.skipped > 0 {
            let what = format!("{} with fewer than three corners left out", self.skipped);
            notes.insert("import.faces".into(), what);
        }
        notes
    }
}

/// A camera in front (towards +z) of a mesh that sees all of it.
fn frame(mesh: &Mesh) -> Option<Camera> {
    let (lo, hi) = mesh.bounds()?;
    let (centre, radius) = ((lo + hi) * 0.5, (hi - lo).length() * 0.5);
    let distance = radius / libm::sinf(FRAME_FOV_DEG.to_radians() * 0.5);
    let distance = distance.max(f32::MIN_POSITIVE);
    let intrinsics = Intrinsics::from_fov(FRAME_FOV_DEG, FRAME_PIXELS, FRAME_PIXELS);
    let origin = centre + Vec3::new(0.0, 0.0, distance);
    let mut camera = Camera::look_at(origin, centre, intrinsics);
    (camera.right, camera.down, camera.forward) = (
        Vec3::new(1.0, 0.0, 0.0),
        Vec3::new(0.0, -1.0, 0.0),
        Vec3::new(0.0, 0.0, -1.0),
    );
    Some(camera)
}

/// Reads a whole file; the message names the element and quotes nothing: the file may be something else.
pub(super) fn parse(bytes: &[u8]) -> Result<Ply, String> {
    if !is_ply(bytes) {
        return Err("is not PLY: its first line is not `ply`".into());
    }
    let (encoding, elements, start) = header::parse(bytes)?;
    let mut body = Body {
        encoding,
        rest: &bytes[start..],
    };
    let mut ply = Ply::default();
    let mut vertices = 0;
    for element in &elements {
        body.fits(element)?;
        let mut colour = Mean::default();
        match element.name.as_str() {
            "vertex" => {
                read_vertices(&mut body, element, &mut ply, &mut colour)?;
                vertices = ply.positions.len();
            }
            "face" => read_faces(&mut body, element, &mut ply, &mut colour)?,
            _ => read_rows(&mut body, element, |_| Ok(()))?,
        }
        ply.colour = ply.colour.or(colour.finish());
    }
    if ply.triangles.is_empty() {
        return Err("element face: no triangles; export a mesh with faces (no point cloud)".into());
    }
    match ply
        .triangles
        .iter()
        .flatten()
        .find(|&&v| v as usize >= vertices)
    {
        Some(v) => Err(format!(
            "element face: index {v} points past {vertices} vertices"
        )),
        None => Ok(ply),
    }
}

fn read_vertices(
    body: &mut Body<'_>,
    element: &Element,
    ply: &mut Ply,
    colour: &mut Mean,
) -> Result<(), String> {
    let needs = |name: &str| {
        element
            .find(&[name])
            .ok_or_else(|| format!("element vertex: has no property {name}"))
    };
    let place = [needs("x")?, needs("y")?, needs("z")?];
    let coordinates =
        element
            .find(&["u", "s", "texture_u"])
            .zip(element.find(&["v", "t", "texture_v"]));
    let channels = Channels::of(element);
    ply.positions.reserve(element.count);
    read_rows(body, element, |row| {
        let at = |k: usize| row.first(k) as f32;
        ply.positions.push(Vec3::from(place.map(at)));
        if let Some((u, v)) = coordinates {
            ply.uv.push([at(u), at(v)]);
        }
        channels.add(row, colour);
        Ok(())
    })
}

fn read_faces(
    body: &mut Body<'_>,
    element: &Element,
    ply: &mut Ply,
    colour: &mut Mean,
) -> Result<(), String> {
    let Some(list) = element.find(&["vertex_indices", "vertex_index"]) else {
        return Err("element face: has no list vertex_indices; export the mesh with faces".into());
    };
    let channels = Channels::of(element);
    read_rows(body, element, |row| {
        let corners = row.all(list);
        let index = |k: usize| {
            let v = corners[k];
            if (0.0..=f64::from(u32::MAX)).contains(&v) {
                Ok(v as u32)
            } else {
                Err(format!("element face: index {v} is no vertex"))
            }
        };
        if corners.len() < 3 {
            ply.skipped += 1;
        }
        for k in 2..corners.len() {
            ply.triangles.push([index(0)?, index(k - 1)?, index(k)?]);
        }
        channels.add(row, colour);
        Ok(())
    })
}

/// The numbers of one row, and where each property's start.
struct Row {
    numbers: Vec<f64>,
    starts: Vec<usize>,
}

impl Row {
    fn first(&self, property: usize) -> f64 {
        self.all(property).first().copied().unwrap_or(f64::NAN)
    }

    fn all(&self, property: usize) -> &[f64] {
        &self.numbers[self.starts[property]..self.starts[property + 1]]
    }
}

fn read_rows(
    body: &mut Body<'_>,
    element: &Element,
    mut each: impl FnMut(&Row) -> Result<(), String>,
) -> Result<(), String> {
    if element.properties.is_empty() {
        return Ok(());
    }
    let mut row = Row {
        numbers: Vec::new(),
        starts: Vec::new(),
    };
    for k in 0..element.count {
        row.numbers.clear();
        row.starts.clear();
        let at = |what: String| format!("element {} row {k}: {what}", element.name);
        for property in &element.properties {
            row.starts.push(row.numbers.len());
            let count = match property.length {
                None => 1,
                Some(length) => {
                    let count = body.number(length).map_err(at)?;
                    let most = body.rest.len() / body.least(property.number);
                    if !(0.0..=most as f64).contains(&count) {
                        let what = format!("list {} of {count} does not fit", property.name);
                        return Err(at(what));
                    }
                    count as usize
                }
            };
            for _ in 0..count {
                row.numbers.push(body.number(property.number).map_err(at)?);
            }
        }
        row.starts.push(row.numbers.len());
        each(&row)?;
    }
    Ok(())
}

/// What is left of the file after the header.
struct Body<'a> {
    encoding: Encoding,
    rest: &'a [u8],
}

impl Body<'_> {
    /// Fewest bytes that a number takes up.
    fn least(&self, number: Number) -> usize {
        match self.encoding {
            Encoding::Ascii => 1,
            _ => number.size(),
        }
    }

    /// Refuses counts that the rest of the file cannot hold, before anything is allocated for them.
    fn fits(&self, element: &Element) -> Result<(), String> {
        let one: usize = element
            .properties
            .iter()
            .map(|p| self.least(p.length.unwrap_or(p.number)))
            .sum();
        let need = element.count.checked_mul(one);
        if need.is_some_and(|need| need <= self.rest.len()) {
            return Ok(());
        }
        Err(format!(
            "element {}: {} rows do not fit the {} bytes left; the file is cut short or damaged",
            element.name,
            element.count,
            self.rest.len()
        ))
    }

    fn number(&mut self, number: Number) -> Result<f64, String> {
        const SHORT: &str = "the file is cut short";
        if self.encoding == Encoding::Ascii {
            let start = self.rest.iter().position(|b| !b.is_ascii_whitespace());
            let rest = &self.rest[start.ok_or(SHORT)?..];
            let end = rest.iter().position(u8::is_ascii_whitespace);
            let (word, rest) = rest.split_at(end.unwrap_or(rest.len()));
            self.rest = rest;
            let text = std::str::from_utf8(word).unwrap_or("?");
            return text.parse().map_err(|_| "expected a number".to_owned());
        }
        let (word, rest) = self.rest.split_at_checked(number.size()).ok_or(SHORT)?;
        self.rest = rest;
        let mut bytes = [0; 8];
        bytes[..word.len()].copy_from_slice(word);
        if self.encoding == Encoding::Big {
            bytes[..word.len()].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match number {
            Number::I8 => f64::from(a as i8),
            Number::U8 => f64::from(a),
            Number::I16 => f64::from(i16::from_le_bytes([a, b])),
            Number::U16 => f64::from(u16::from_le_bytes([a, b])),
            Number::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Number::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Number::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Number::F64 => f64::from_le_bytes(bytes),
        })
    }
}

/// Where an element keeps its colour: bytes are sRGB, floats linear.
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
