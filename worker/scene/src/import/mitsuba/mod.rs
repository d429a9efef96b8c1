//! Mitsuba 3 scenes, as XML or as the Python dictionary written as JSON.
//!
//! Supported: sensor `perspective` (`fov`, `fov_axis`, `principal_point_offset_*`, film size);
//! shapes `ply`, `obj`, `rectangle`, `cube`, `disk` and `sphere` (the last two tessellated); BSDFs
//! `diffuse`, `roughconductor` (`material` none or a common metal), `conductor` (α = 0.001),
//! `twosided` and `blendbsdf` of all these, nested too; `dielectric` on closed shapes and
//! `thindielectric`, on their own; `bitmap` textures; `spectrum` with values by wavelength
//! (`450:0.2, 905:0.7`) as a reflectance; references, `<default>` parameters, and every transform.
//! A shape without BSDF has Mitsuba's default, a one-sided diffuse of 0.5. Facets are flat: vertex
//! normals are not used. Integrators, samplers and media are skipped with a note; any other plugin
//! is an error that names it. As in Mitsuba, every property of a plugin must be used: any other is
//! an error, unless it changes neither geometry nor light. Files of versions before 2 may have the
//! names of their time (`toWorld`, `fovAxis`). As in Mitsuba, `rotate` does not normalise its axis:
//! if its length is not 1, the map shears.
//!
//! **The laser.** Mitsuba has no collimated emitter. As in mitransient scenes, a beam is an emitter
//! `projector` with `fov` ≤ 2° or `spot` with `cutoff_angle` ≤ 1°, along +z of its `to_world`.
//! Several beams form a grid, and all must start at one point. The power is not read: every beam
//! has unit energy. Other emitters are omitted with a note.
//!
//! **Labels.** A shape's category is its id up to the first `.` (`chair.2` is a `chair`), else
//! `unlabelled`.
//!
//! In files of [`crate::export`], a comment of the scene that starts with `picofarm` contains the
//! data that Mitsuba cannot represent: exact materials, labels, spots and provenance. Each entry is
//! used only if its element still has the exported text; edited elements are read like those of any
//! other file.

mod blend;
mod bsdf;
mod colour;
mod dictionary;
mod node;
mod old;
mod properties;
mod shape;
mod transform;
mod view;
mod xml;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    rc::Rc,
    sync::Arc,
};

use crate::{
    Affine, Material, Mesh, Object, Provenance, SceneError, Wrap, export::mitsuba::text::Extras,
};

use super::complete::{Draft, FileLaser};
use super::{ImportOptions, Opener, add_note, far, format_error, image::Images, of_file, quoted};
use blend::Leaf;
use bsdf::Look;
use node::{Child, Node};
use shape::Geometry;
pub(super) use transform::Matrix;

/// The category of shapes with an id that names none.
const UNLABELLED: &str = "unlabelled";
/// The greatest number of vertices, triangles and rows of spectra of a scene, counting each
/// instance.
const MAX_SIZE: usize = 1 << 28;

/// Reads a scene in XML; the caller validates the result.
pub(super) fn read_xml(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
    files: &Opener,
) -> Result<Draft, SceneError> {
    let fail = |what: String| format_error(path, what);
    let text = std::str::from_utf8(bytes).map_err(|e| fail(format!("is not UTF-8 text: {e}")))?;
    let (root, extras) = xml::parse(text.trim_start_matches('\u{feff}')).map_err(fail)?;
    let extras = extras
        .map(|text| serde_json::from_str::<Extras>(&text))
        .transpose()
        .map_err(|e| fail(format!("comment picofarm: {e}; remove it, or export again")))?;
    Reader::new((path, files), root, extras)
        .scene(options)
        .map_err(|what| format_error(path, what))
}

/// Reads a scene from its dictionary in JSON; the caller validates the result.
pub(super) fn read_dictionary(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
    files: &Opener,
) -> Result<Draft, SceneError> {
    let fail = |what: String| format_error(path, what);
    let root = dictionary::parse(bytes).map_err(fail)?;
    Reader::new((path, files), root, None)
        .scene(options)
        .map_err(|what| format_error(path, what))
}

/// Returns the files that a scene in XML or JSON refers to, in order of their names.
///
/// # Errors
/// A name that is not a plain path.
pub(super) fn files(path: &Path, bytes: &[u8]) -> Result<Vec<PathBuf>, SceneError> {
    let root = match std::str::from_utf8(bytes) {
        Ok(text) if text.trim_start().starts_with('{') => dictionary::parse(bytes).ok(),
        Ok(text) => xml::parse(text.trim_start_matches('\u{feff}'))
            .ok()
            .map(|x| x.0),
        Err(_) => None,
    };
    let mut names = Vec::new();
    let mut open: Vec<Rc<Node>> = root.map(Rc::new).into_iter().collect();
    while let Some(node) = open.pop() {
        if let Ok(Some(name)) = node.text("filename") {
            names.push(Opener::named(folder(path), name).map_err(of_file)?);
        }
        for (_, child) in &node.children {
            if let Child::Node(child) = child {
                open.push(child.clone());
            }
        }
    }
    names.sort();
    names.dedup();
    Ok(names)
}

fn folder(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

struct Reader<'a> {
    path: &'a Path,
    files: &'a Opener,
    root: Rc<Node>,
    ids: BTreeMap<String, Rc<Node>>,
    extras: Option<Extras>,
    images: Images<(PathBuf, Wrap, bool)>,
    /// Materials by the address of their node, which exists as long as `root`.
    looks: BTreeMap<usize, Look>,
    /// The parts of blends, likewise.
    leaves: BTreeMap<usize, Rc<Leaf>>,
    geometries: BTreeMap<PathBuf, Geometry>,
    notes: BTreeMap<String, String>,
    /// The position of the scene's origin in the file's coordinates.
    origin: [f64; 3],
}

impl<'a> Reader<'a> {
    fn new((path, files): (&'a Path, &'a Opener), root: Node, extras: Option<Extras>) -> Self {
        let root = Rc::new(root);
        let mut ids = BTreeMap::new();
        let mut open = vec![root.clone()];
        while let Some(node) = open.pop() {
            for (_, child) in &node.children {
                if let Child::Node(child) = child {
                    open.push(child.clone());
                }
            }
            if !node.id.is_empty() {
                ids.entry(node.id.clone()).or_insert(node);
            }
        }
        Self {
            path,
            files,
            root,
            ids,
            extras,
            images: Images::default(),
            looks: BTreeMap::new(),
            leaves: BTreeMap::new(),
            geometries: BTreeMap::new(),
            notes: BTreeMap::new(),
            origin: [0.0; 3],
        }
    }

    /// Returns the file that an element names.
    fn named(&self, node: &Node, name: &str) -> Result<PathBuf, String> {
        Opener::named(folder(self.path), name).map_err(|e| node.fail(e))
    }

    fn note(&mut self, key: &str, what: impl Into<String>) {
        add_note(&mut self.notes, key, what.into());
    }

    /// Converts a transform to the scene's coordinates.
    fn placed(&self, place: &Matrix) -> Matrix {
        match self.origin == [0.0; 3] {
            true => *place,
            false => Matrix::translation(self.origin.map(|x| -x)).after(place),
        }
    }

    /// Moves a scene far from the origin of its file to its camera.
    fn move_to_camera(&mut self, sensor: Option<&Rc<Node>>) -> Result<(), String> {
        if self.extras.is_some() {
            return Ok(());
        }
        if let Some(sensor) = sensor {
            let origin = sensor.transform("to_world")?.origin();
            if far::is_lossy(origin, f64::INFINITY) {
                self.origin = origin;
                self.note("origin", far::note(origin));
            }
        }
        Ok(())
    }

    fn resolved(&self, node: &Node, child: &Child) -> Result<Rc<Node>, String> {
        match child {
            Child::Node(child) => Ok(child.clone()),
            Child::Reference(id) => self.ids.get(id).cloned().ok_or_else(|| {
                node.fail(format!(
                    "refers to {}, which no element has as its id",
                    quoted(id)
                ))
            }),
        }
    }

    /// Returns the children of one tag, with references resolved.
    fn children(&self, node: &Node, tag: &str) -> Result<Vec<Rc<Node>>, String> {
        let mut found = Vec::new();
        for (_, child) in &node.children {
            let child = self.resolved(node, child)?;
            if child.tag == tag {
                found.push(child);
            } else if child.tag.is_empty() {
                let what = format!("plugin {} is not supported", quoted(&child.kind));
                return Err(child.fail(what));
            }
        }
        Ok(found)
    }

    fn children_named(&self, node: &Node, name: &str) -> Result<Vec<Rc<Node>>, String> {
        node.children
            .iter()
            .filter(|(n, _)| n == name)
            .map(|(_, child)| self.resolved(node, child))
            .collect()
    }

    /// Adds notes on the elements that the parser skipped.
    fn note_skipped(&mut self) {
        let mut open = vec![self.root.clone()];
        while let Some(node) = open.pop() {
            for tag in &node.skipped {
                match tag.as_str() {
                    "medium" | "volume" | "phase" => self.note(
                        "media",
                        "left out: light travels through empty space and through glass only",
                    ),
                    // Our own files contain such elements for other programs.
                    _ if self.extras.is_none() => self.note(
                        "skipped",
                        "integrators, samplers and filters: the job or the options of a render decide these",
                    ),
                    _ => {}
                }
            }
            for (_, child) in &node.children {
                if let Child::Node(child) = child {
                    open.push(child.clone());
                }
            }
        }
    }

    fn scene(mut self, options: &ImportOptions) -> Result<Draft, String> {
        let root = self.root.clone();
        let shapes = self.children(&root, "shape")?;
        self.only(&root, &properties::SCENE)?;
        self.note_skipped();
        let sensors = self.children(&root, "sensor")?;
        if options.camera.is_none() {
            self.move_to_camera(sensors.first())?;
        }
        let (objects, labels) = self.objects(&shapes)?;
        if sensors.len() > 1 {
            self.note(
                "sensors",
                "more than one; the first is the camera, unless --camera names another",
            );
        }
        let cameras = sensors
            .iter()
            .map(|sensor| (sensor.id.clone(), self.camera(sensor)))
            .collect();
        let emitters = self.children(&root, "emitter")?;
        let laser = self.laser(&emitters)?;
        let stem = self.path.file_stem().unwrap_or_default();
        let (name, mut provenance) = match self.extras {
            Some(extras) => (extras.scene.name, extras.scene.provenance),
            None => {
                let provenance = Provenance {
                    source: "mitsuba".into(),
                    ..Provenance::default()
                };
                (stem.to_string_lossy().into_owned(), provenance)
            }
        };
        for (key, note) in self.notes {
            provenance.notes.insert(format!("import.{key}"), note);
        }
        Ok(Draft {
            name,
            objects,
            labels,
            cameras,
            laser: laser.map(FileLaser::Beams),
            has_unit: true,
            provenance,
        })
    }

    fn objects(&mut self, shapes: &[Rc<Node>]) -> Result<(Vec<Object>, Vec<String>), String> {
        let mut labels = self
            .extras
            .as_ref()
            .map_or_else(Vec::new, |e| e.scene.labels.clone());
        let mut known: BTreeMap<String, usize> = BTreeMap::new();
        for (k, label) in labels.iter().enumerate() {
            known.entry(label.clone()).or_insert(k);
        }
        let mut objects = Vec::new();
        let mut size = 0;
        let mut shared: BTreeMap<Vec<String>, Arc<Mesh>> = BTreeMap::new();
        let groups: Vec<&[Rc<Node>]> = shapes.chunk_by(|a, b| self.same_object(a, b)).collect();
        for parts in groups {
            let first = &parts[0];
            let ours = self.our_object(first);
            let (name, label) = match ours {
                Some(k) => {
                    let object = &self.extras.as_ref().expect("ours has extras").objects[k];
                    (object.name.clone(), object.label.clone())
                }
                None => {
                    let label = first.id.split('.').next().unwrap_or_default();
                    let label = if label.is_empty() { UNLABELLED } else { label };
                    let name = if first.id.is_empty() {
                        &first.kind
                    } else {
                        &first.id
                    };
                    (name.clone(), label.to_owned())
                }
            };
            let label = *known.entry(label).or_insert_with_key(|label| {
                labels.push(label.clone());
                labels.len() - 1
            });
            let label =
                u16::try_from(label).map_err(|_| first.fail("more than 65535 categories"))?;
            let (mesh, place) = self.mesh(parts, &name, ours)?;
            let rows: usize = mesh.materials.iter().map(|m| m.spectrum.len()).sum();
            size += mesh.positions.len() + mesh.triangles.len() + rows;
            if size > MAX_SIZE {
                return Err(first.fail(format!(
                    "more than {MAX_SIZE} vertices, triangles and rows of spectra in all"
                )));
            }
            // Equal shapes of our own files share their mesh, as in the original scene.
            let mesh = match ours {
                Some(_) => {
                    let key = parts.iter().map(|p| self.identity(p)).collect();
                    shared.entry(key).or_insert_with(|| Arc::new(mesh)).clone()
                }
                None => Arc::new(mesh),
            };
            objects.push(Object {
                mesh,
                to_world: place,
                label,
                name,
            });
        }
        Ok((objects, labels))
    }

    /// Returns the key by which shapes of our own files have the same mesh: file and material.
    fn identity(&self, node: &Node) -> String {
        let file = node.text("filename").ok().flatten().unwrap_or_default();
        let material = node.children.iter().find_map(|(_, c)| match c {
            Child::Reference(id) => Some(id.as_str()),
            Child::Node(_) => None,
        });
        format!("{file}\n{}", material.unwrap_or_default())
    }

    /// Returns the index into our extras of a shape `object<k>` or `object<k>.<part>`.
    fn our_object(&self, node: &Node) -> Option<usize> {
        let objects = &self.extras.as_ref()?.objects;
        let number = node.id.strip_prefix("object")?.split('.').next()?;
        number.parse().ok().filter(|k| *k < objects.len())
    }

    fn same_object(&self, a: &Node, b: &Node) -> bool {
        let same = self.our_object(a).is_some() && self.our_object(a) == self.our_object(b);
        same && a.transform("to_world").ok() == b.transform("to_world").ok()
    }

    /// Returns one mesh of a shape, or of the parts as which an object of ours was written.
    fn mesh(
        &mut self,
        parts: &[Rc<Node>],
        name: &str,
        ours: Option<usize>,
    ) -> Result<(Mesh, Affine), String> {
        let mut mesh = Mesh {
            name: name.to_owned(),
            ..Mesh::default()
        };
        if let (Some(k), Some(extras)) = (ours, &self.extras) {
            mesh.name = extras.objects[k].mesh.clone();
        }
        let mut place = Matrix::IDENTITY;
        for part in parts {
            if !self.children(part, "emitter")?.is_empty() {
                self.note(
                    "emitters",
                    "other than beams are ignored; only the laser shines",
                );
            }
            let look = match self.children(part, "bsdf")?.as_slice() {
                [] => Look {
                    material: Material {
                        two_sided: false,
                        ..Material::diffuse("default", [0.5; 3])
                    },
                    to_uv: Matrix::IDENTITY,
                },
                [bsdf] => self.look(bsdf)?,
                _ => return Err(part.fail("has more than one BSDF")),
            };
            let (mut geometry, inner) = self.geometry(part)?;
            let mut inner = inner;
            if parts.len() == 1 {
                inner = inner.after(&Matrix::translation(geometry.origin));
            } else {
                geometry.restore();
            }
            let slot = mesh.materials.len() as u32;
            let mut material = look.material;
            if material.texture.is_some() && geometry.uv.is_empty() {
                self.note(
                    "textures",
                    "left out where a mesh has no texture coordinates",
                );
                material.texture = None;
            }
            mesh.materials.push(material);
            geometry.append_to(&mut mesh, slot, &look.to_uv);
            place = self.placed(&part.transform("to_world")?.after(&inner));
        }
        Ok((mesh, place.affine()))
    }
}
