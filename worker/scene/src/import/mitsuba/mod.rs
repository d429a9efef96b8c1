//! Mitsuba 3 scenes, as XML or as the Python dictionary written as JSON.
//!
//! Supported: sensors `perspective` and `thinlens` (as a pinhole), with crop windows; shapes `ply`,
//! `obj`, `serialized`, `rectangle`, `cube`, `disk`, `sphere` and `cylinder` (the last three
//! tessellated), and instances of shape groups; BSDFs `diffuse`, `roughconductor` and `conductor`
//! (`material` none, a common metal, or `eta` and `k`; α of a smooth one = 0.001), `plastic`,
//! `roughplastic` and `pplastic` (their Lambertian part), `principled` (as glTF's metallic and
//! rough materials), and `twosided`, `mask`, `bumpmap`, `normalmap` and `blendbsdf` of all these,
//! nested too; `dielectric` and `roughdielectric` on closed shapes and `thindielectric`, on their
//! own; `bitmap` textures, `checkerboard` as its mean; `spectrum` with values by wavelength
//! (`450:0.2, 905:0.7`) as a reflectance; references, `<alias>`, `<default>` parameters,
//! `<include>`, `<path>`, and every transform. A shape without BSDF has Mitsuba's default, a
//! one-sided diffuse of 0.5. Facets are flat: vertex normals are not used. Integrators, samplers
//! and media are skipped with a note, and so is each approximation above; any other plugin is an
//! error that names it. As in Mitsuba, every property of a plugin must be used: any other is an
//! error, unless it changes neither geometry nor light. Files of versions before 2 may have the
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
mod glass;
mod metal;
mod node;
mod old;
mod properties;
mod serialized;
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
    Material, Mesh, Object, Provenance, SceneError, Wrap, body, export::mitsuba::text::Extras,
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
    let parsed = xml::parse(text, path, files).map_err(fail)?;
    let extras = parsed
        .extras
        .map(|text| serde_json::from_str::<Extras>(&text))
        .transpose()
        .map_err(|e| fail(format!("comment picofarm: {e}; remove it, or export again")))?;
    Reader::new((path, files), parsed.root, extras)
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
    let root = dictionary::parse(bytes, path).map_err(fail)?;
    Reader::new((path, files), root, None)
        .scene(options)
        .map_err(|what| format_error(path, what))
}

/// Returns the files that a scene in XML or JSON refers to, in order of their names.
///
/// # Errors
/// A name that is not a plain path.
pub(super) fn files(
    path: &Path,
    bytes: &[u8],
    opener: &Opener,
) -> Result<Vec<PathBuf>, SceneError> {
    let mut names = Vec::new();
    let root = match std::str::from_utf8(bytes) {
        Ok(text) if text.trim_start().starts_with('{') => dictionary::parse(bytes, path).ok(),
        Ok(text) => xml::parse(text, path, opener).ok().map(|parsed| {
            names = parsed.included;
            parsed.root
        }),
        Err(_) => None,
    };
    let mut open: Vec<Rc<Node>> = root.map(Rc::new).into_iter().collect();
    while let Some(node) = open.pop() {
        if let Ok(Some(name)) = node.text("filename")
            && node.tag != "emitter"
        {
            names.push(xml::resolved(opener, &node.folders, name).map_err(of_file)?);
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

/// The greatest number of objects of a scene, instances included.
const MAX_OBJECTS: usize = 1_000_000;

/// A shape, and the transform of its instance.
struct Placed {
    shape: Rc<Node>,
    to_world: Matrix,
    in_group: bool,
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
    /// Geometries by file and index of the mesh in it.
    geometries: BTreeMap<(PathBuf, usize), Geometry>,
    notes: BTreeMap<String, String>,
    /// The position of the scene's origin in the file's coordinates.
    origin: [f64; 3],
}

impl<'a> Reader<'a> {
    fn new((path, files): (&'a Path, &'a Opener), root: Node, extras: Option<Extras>) -> Self {
        let root = Rc::new(root);
        let mut ids: BTreeMap<String, Rc<Node>> = root.aliases.iter().cloned().collect();
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
        xml::resolved(self.files, &node.folders, name).map_err(|e| node.fail(e))
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
        let (mut objects, labels) = self.objects(&shapes)?;
        self.note_thinned(&body::thin_open_bodies(&mut objects));
        let mut cameras = Vec::new();
        for sensor in &sensors {
            match sensor.kind.as_str() {
                "perspective" | "thinlens" => {
                    cameras.push((sensor.id.clone(), self.camera(sensor)));
                }
                kind => self.note("sensors.kind", format!("{} ignored", quoted(kind))),
            }
        }
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
        // The meshes of shape groups, by the address of their shape.
        let mut grouped: BTreeMap<usize, (Arc<Mesh>, Matrix)> = BTreeMap::new();
        let shapes = self.expanded(shapes)?;
        let groups: Vec<&[Placed]> = shapes
            .chunk_by(|a, b| self.same_object(&a.shape, &b.shape))
            .collect();
        for parts in groups {
            let first = &parts[0].shape;
            let instance = parts[0].to_world;
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
            let key = Rc::as_ptr(first).addr();
            if let Some((mesh, place)) = grouped.get(&key) {
                size += mesh.positions.len() + mesh.triangles.len();
                if size > MAX_SIZE {
                    return Err(first.fail(too_large()));
                }
                objects.push(Object {
                    mesh: mesh.clone(),
                    to_world: self.placed(&parts[0].to_world.after(place)).affine(),
                    label,
                    name,
                });
                continue;
            }
            let nodes: Vec<Rc<Node>> = parts.iter().map(|p| p.shape.clone()).collect();
            let (mesh, place) = self.mesh(&nodes, &name, ours)?;
            let rows: usize = mesh.materials.iter().map(|m| m.spectrum.len()).sum();
            size += mesh.positions.len() + mesh.triangles.len() + rows;
            if size > MAX_SIZE {
                return Err(first.fail(too_large()));
            }
            // Equal shapes of our own files share their mesh, as in the original scene.
            let mesh = match ours {
                Some(_) => {
                    let key = nodes.iter().map(|p| self.identity(p)).collect();
                    shared.entry(key).or_insert_with(|| Arc::new(mesh)).clone()
                }
                None => Arc::new(mesh),
            };
            if parts[0].in_group {
                grouped.insert(key, (mesh.clone(), place));
            }
            objects.push(Object {
                mesh,
                to_world: self.placed(&instance.after(&place)).affine(),
                label,
                name,
            });
        }
        Ok((objects, labels))
    }

    /// Returns the shapes of a scene, with the shapes of a group in the place of each instance.
    fn expanded(&mut self, shapes: &[Rc<Node>]) -> Result<Vec<Placed>, String> {
        let mut all = Vec::new();
        for shape in shapes {
            match shape.kind.as_str() {
                // Groups are visible only as instances.
                "shapegroup" => self.only(shape, &properties::GROUP)?,
                "instance" => {
                    self.only(shape, &properties::INSTANCE)?;
                    let groups = self.children(shape, "shape")?;
                    let [group] = groups.as_slice() else {
                        return Err(shape.fail("expected a reference to one shapegroup"));
                    };
                    if group.kind != "shapegroup" {
                        return Err(shape.fail("expected a reference to a shapegroup"));
                    }
                    let to_world = shape.transform("to_world")?;
                    for part in self.children(group, "shape")? {
                        if matches!(part.kind.as_str(), "shapegroup" | "instance") {
                            return Err(part.fail("groups cannot contain instances"));
                        }
                        all.push(Placed {
                            shape: part,
                            to_world,
                            in_group: true,
                        });
                    }
                    if all.len() > MAX_OBJECTS {
                        return Err(shape.fail(format!("more than {MAX_OBJECTS} objects in all")));
                    }
                }
                _ if self.lets_light_pass(shape)? => {}
                _ => all.push(Placed {
                    shape: shape.clone(),
                    to_world: Matrix::IDENTITY,
                    in_group: false,
                }),
            }
        }
        Ok(all)
    }

    /// Returns whether light passes a shape, and notes the omission.
    fn lets_light_pass(&mut self, shape: &Node) -> Result<bool, String> {
        let bsdfs = self.children(shape, "bsdf")?;
        match bsdfs.as_slice() {
            [bsdf] if bsdf.kind == "null" => {
                self.note("null", "shapes with the BSDF null left out");
            }
            [bsdf] if matches!(bsdf.kind.as_str(), "polarizer" | "retarder" | "circular") => {
                self.note(
                    "polarizers",
                    "and retarders left out, because light has no polarization here",
                );
            }
            _ => return Ok(false),
        }
        Ok(true)
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
    ) -> Result<(Mesh, Matrix), String> {
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
            if !self.children(part, "sensor")?.is_empty() {
                self.note("sensors.shapes", "of shapes ignored");
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
            place = part.transform("to_world")?.after(&inner);
        }
        Ok((mesh, place))
    }
}

fn too_large() -> String {
    format!("more than {MAX_SIZE} vertices, triangles and rows of spectra in all")
}
