//! glTF 2.0 to scene: node transforms, labels and ids from extras, materials, camera and laser.

mod material;
mod mesh;
mod parts;

use std::{collections::BTreeMap, path::Path, sync::Arc};

use gltf::{Gltf, Node, Semantic, json::validation::Checked};
use serde::de::DeserializeOwned;

use crate::{
    Affine, Camera, Mesh, Object, Provenance, Scene, SceneError, Vec3, Wrap,
    extras::{FORMAT, Keyed, NodeExtras, SceneExtras},
};

use parts::laser_of;

use super::{ImportOptions, Opener, buffers::Buffers, compose, format_error, image::Images};

/// Deepest nesting of nodes.
const MAX_DEPTH: usize = 1000;
/// Category of nodes without a `label`.
const UNLABELLED: &str = "unlabelled";

/// Reads `.glb` or `.gltf` bytes; the caller validates the result.
pub(super) fn read(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
    files: &Opener,
) -> Result<Scene, SceneError> {
    let (document, buffers) = open(path, bytes, files)?;
    let root = root(path, &document)?;
    let ours: Option<SceneExtras> = keyed(
        path,
        "scene.extras.picofarm",
        root.extras().as_deref().map(|r| r.get()),
    )?;
    if let Some(e) = &ours
        && e.format != FORMAT
    {
        return Err(format_error(
            path,
            format!(
                "scene.extras.picofarm.format: {} is not {FORMAT}; this program is too old or too new for it",
                e.format
            ),
        ));
    }
    let labels = ours.as_ref().map_or_else(Vec::new, |e| e.labels.clone());
    let walk = Walk::over((path, files), &document, &buffers, labels)?;
    walk.finish(&root, ours, options)
}

/// Reads `.glb` or `.gltf` bytes as one mesh in the file's own frame, with the notes on what was dropped. Cameras
/// and lasers are not looked for; the caller checks the numbers.
pub(super) fn read_model(
    path: &Path,
    bytes: &[u8],
    files: &Opener,
) -> Result<(Mesh, BTreeMap<String, String>), SceneError> {
    let (document, buffers) = open(path, bytes, files)?;
    let walk = Walk::over((path, files), &document, &buffers, Vec::new())?;
    let mut all = Mesh {
        name: path
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into(),
        ..Mesh::default()
    };
    for (_, object) in &walk.objects {
        let (mesh, base) = (&object.mesh, all.positions.len());
        let slot = all.materials.len() as u32;
        let place = |p: &Vec3| object.to_world.point(*p);
        all.positions.extend(mesh.positions.iter().map(place));
        if !mesh.uv.is_empty() {
            all.uv.resize(base, [0.0; 2]);
            all.uv.extend(&mesh.uv);
        }
        if !all.uv.is_empty() {
            all.uv.resize(all.positions.len(), [0.0; 2]);
        }
        let shift = |t: &[u32; 3]| t.map(|v| v + base as u32);
        all.triangles.extend(mesh.triangles.iter().map(shift));
        let shift = |m: &u32| m + slot;
        all.triangle_material
            .extend(mesh.triangle_material.iter().map(shift));
        all.materials.extend(mesh.materials.iter().cloned());
    }
    Ok((all, walk.notes))
}

fn open(
    path: &Path,
    bytes: &[u8],
    files: &Opener,
) -> Result<(gltf::Document, Buffers), SceneError> {
    let fail = |e: gltf::Error| {
        let what = format!("is not readable glTF 2.0 ({e}); copy or export it again");
        format_error(path, what)
    };
    let Gltf { document, blob } = Gltf::from_slice_without_validation(bytes).map_err(fail)?;
    let json = document.into_json();
    unguarded(&json).map_err(|what| format_error(path, what))?;
    let document = gltf::Document::from_json(json).map_err(fail)?;
    let buffers = Buffers::read(path, &document, blob, files)?;
    Ok((document, buffers))
}

/// What the `gltf` crate relies on before or without checking it.
fn unguarded(json: &gltf::json::Root) -> Result<(), String> {
    let position = Checked::Valid(Semantic::Positions);
    for (m, mesh) in json.meshes.iter().enumerate() {
        for (p, primitive) in mesh.primitives.iter().enumerate() {
            let accessor = primitive.attributes.get(&position);
            if accessor.is_some_and(|a| a.value() >= json.accessors.len()) {
                return Err(format!(
                    "meshes[{m}].primitives[{p}].attributes.POSITION: no such accessor; export the file again"
                ));
            }
        }
    }
    let whole = |i: &gltf::json::Image| match i.buffer_view {
        Some(_) => i.mime_type.is_some(),
        None => i.uri.is_some(),
    };
    match json.images.iter().position(|i| !whole(i)) {
        Some(k) => Err(format!(
            "images[{k}]: needs a uri, or a bufferView with mimeType; export the file again"
        )),
        None => Ok(()),
    }
}

fn root<'a>(path: &Path, document: &'a gltf::Document) -> Result<gltf::Scene<'a>, SceneError> {
    document
        .default_scene()
        .or_else(|| document.scenes().next())
        .ok_or_else(|| format_error(path, "scenes: the file has none; export at least one scene"))
}

/// Every node has one parent at most, and the scene's own nodes have none; otherwise a walk might not end.
fn is_a_forest(
    path: &Path,
    document: &gltf::Document,
    root: &gltf::Scene<'_>,
) -> Result<(), SceneError> {
    let mut parents = vec![0u32; document.nodes().len()];
    let children = document.nodes().flat_map(|n| {
        let inner: Vec<usize> = n.children().map(|c| c.index()).collect();
        inner
    });
    for node in root.nodes().map(|n| n.index()).chain(children) {
        parents[node] += 1;
    }
    match parents.iter().position(|&n| n > 1) {
        Some(node) => Err(format_error(
            path,
            format!(
                "nodes[{node}]: has more than one parent; glTF nodes must form trees, export again"
            ),
        )),
        None => Ok(()),
    }
}

/// Parses `extras` that hold our key; `None` where they are absent or someone else's.
fn keyed<T: DeserializeOwned>(
    path: &Path,
    field: &str,
    raw: Option<&str>,
) -> Result<Option<T>, SceneError> {
    let Some(raw) = under(path, field, raw, "picofarm")? else {
        return Ok(None);
    };
    // From the text again: a generic JSON value would round f32 numbers twice.
    serde_json::from_str::<Keyed<T>>(raw)
        .map(|k| Some(k.picofarm))
        .map_err(|e| format_error(path, format!("{field}: {e}")))
}

/// The text of `extras` that hold a key; `None` where they are absent or hold others.
fn under<'r>(
    path: &Path,
    field: &str,
    raw: Option<&'r str>,
    key: &str,
) -> Result<Option<&'r str>, SceneError> {
    let Some(raw) = raw else { return Ok(None) };
    let value: serde_json::Value = match serde_json::from_str(raw) {
        Ok(value) => value,
        Err(e) => return Err(format_error(path, format!("{field}: {e}"))),
    };
    Ok(value.get(key).is_some().then_some(raw))
}

struct Walk<'a> {
    path: &'a Path,
    files: &'a Opener,
    buffers: &'a Buffers,
    images: Images<(usize, Wrap)>,
    /// Vertices and corners read so far.
    corners: usize,
    meshes: BTreeMap<usize, Option<Arc<Mesh>>>,
    objects: Vec<(Option<u32>, Object)>,
    labels: Vec<String>,
    camera: Option<Camera>,
    laser: Option<(Affine, NodeExtras)>,
    notes: BTreeMap<String, String>,
}

impl<'a> Walk<'a> {
    /// Everything that the document's scene places.
    fn over(
        (path, files): (&'a Path, &'a Opener),
        document: &gltf::Document,
        buffers: &'a Buffers,
        labels: Vec<String>,
    ) -> Result<Self, SceneError> {
        let root = root(path, document)?;
        is_a_forest(path, document, &root)?;
        let mut walk = Walk {
            path,
            files,
            buffers,
            images: Images::default(),
            corners: 0,
            meshes: BTreeMap::new(),
            objects: Vec::new(),
            labels,
            camera: None,
            laser: None,
            notes: BTreeMap::new(),
        };
        walk.dropped_parts(document);
        for node in root.nodes() {
            walk.node(&node, &Affine::IDENTITY, None, 0)?;
        }
        Ok(walk)
    }

    fn node(
        &mut self,
        node: &Node<'_>,
        parent: &Affine,
        label: Option<&str>,
        depth: usize,
    ) -> Result<(), SceneError> {
        if depth > MAX_DEPTH {
            let what = format!("nodes[{}]: nested deeper than {MAX_DEPTH}", node.index());
            return Err(format_error(self.path, what));
        }
        let to_world = compose(parent, &affine(node.transform().matrix()));
        let at = format!("nodes[{}].extras", node.index());
        let extras: NodeExtras = match node.extras() {
            Some(raw) => serde_json::from_str(raw.get()).map_err(|e| {
                format_error(
                    self.path,
                    format!("{at}: {e}; expected label (text) and instance (number)"),
                )
            })?,
            None => NodeExtras::default(),
        };
        let label = extras.label.as_deref().or(label);
        if let Some(mesh) = node.mesh() {
            self.object(node, &mesh, to_world, label, extras.instance)?;
        }
        if let (None, Some(camera)) = (&self.camera, node.camera()) {
            self.camera = Some(self.camera_of(&to_world, &camera)?);
        }
        if self.laser.is_none()
            && (extras.laser_spots.is_some() || extras.laser_directions.is_some())
        {
            self.laser = Some((to_world, extras.clone()));
        }
        for child in node.children() {
            self.node(&child, &to_world, label, depth + 1)?;
        }
        Ok(())
    }

    fn object(
        &mut self,
        node: &Node<'_>,
        mesh: &gltf::Mesh<'_>,
        to_world: Affine,
        label: Option<&str>,
        instance: Option<u32>,
    ) -> Result<(), SceneError> {
        let shared = match self.meshes.get(&mesh.index()) {
            Some(known) => known.clone(),
            None => {
                let read = self.mesh(mesh)?.map(Arc::new);
                self.meshes.insert(mesh.index(), read.clone());
                read
            }
        };
        let Some(shared) = shared else { return Ok(()) };
        let label = label.unwrap_or_else(|| {
            self.notes.insert(
                "labels".into(),
                format!("some nodes have no label in their extras; they are {UNLABELLED:?}"),
            );
            UNLABELLED
        });
        let known = self.labels.iter().position(|l| l == label);
        let label = known.unwrap_or_else(|| {
            self.labels.push(label.to_owned());
            self.labels.len() - 1
        });
        let label = u16::try_from(label).map_err(|_| {
            format_error(
                self.path,
                "nodes[].extras.label: more than 65535 categories",
            )
        })?;
        self.objects.push((
            instance,
            Object {
                mesh: shared,
                to_world,
                label,
                name: node.name().or(mesh.name()).unwrap_or("object").to_owned(),
            },
        ));
        Ok(())
    }

    fn finish(
        mut self,
        root: &gltf::Scene<'_>,
        ours: Option<SceneExtras>,
        options: &ImportOptions,
    ) -> Result<Scene, SceneError> {
        let path = self.path;
        let count = self.objects.len();
        let mut ids: Vec<Option<u32>> = self.objects.iter().map(|(id, _)| *id).collect();
        ids.sort_unstable();
        if ids.iter().enumerate().all(|(k, id)| *id == Some(k as u32)) {
            self.objects.sort_by_key(|(id, _)| *id);
        } else if ids.iter().any(Option::is_some) {
            self.notes.insert(
                "instances".into(),
                format!("ids in extras are not 0..{count}; objects are numbered in file order"),
            );
        }
        let (camera, laser, mut provenance, name) = match ours {
            Some(e) => (e.camera, e.laser, e.provenance, e.name),
            None => {
                let camera = options.camera.or(self.camera).ok_or_else(|| {
                    format_error(
                        path,
                        "camera: no node has one; add a perspective camera, or state one on import",
                    )
                })?;
                let laser = match (&options.laser, &self.laser) {
                    (Some(aim), _) => aim.laser(&camera),
                    (None, Some((to_world, extras))) => laser_of(path, to_world, extras, &camera)?,
                    (None, None) => {
                        return Err(format_error(
                            path,
                            "laser: no node's extras hold \"laser_spots\" (1, 4, 16, 25 or 100) or \
                             \"laser_directions\" ([[x, y, z], …]); add one, or state a grid on import",
                        ));
                    }
                };
                let provenance = Provenance {
                    source: "gltf".into(),
                    ..Provenance::default()
                };
                let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
                let name = root.name().map(str::to_owned).or(stem).unwrap_or_default();
                (camera, laser, provenance, name)
            }
        };
        for (key, note) in self.notes {
            provenance.notes.insert(format!("import.{key}"), note);
        }
        Ok(Scene {
            name,
            objects: self.objects.into_iter().map(|(_, object)| object).collect(),
            labels: self.labels,
            camera,
            laser,
            provenance,
        })
    }
}

/// glTF's column-major matrix as an affine map.
fn affine(m: [[f32; 4]; 4]) -> Affine {
    let row = |k: usize| Vec3::new(m[0][k], m[1][k], m[2][k]);
    Affine {
        linear: [row(0), row(1), row(2)],
        translation: Vec3::new(m[3][0], m[3][1], m[3][2]),
    }
}
