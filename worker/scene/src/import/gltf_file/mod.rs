//! Converts glTF 2.0 to scenes: node transforms, labels and ids from extras, materials, camera and
//! laser.

mod deform;
pub(super) mod document;
mod draco;
mod glb;
mod glossiness;
mod mask;
mod material;
mod mesh;
mod meshopt;
mod nodes;
mod parts;
mod plain;

use std::{collections::BTreeMap, path::Path, sync::Arc};

use gltf::{Node, camera::Projection};
use serde::de::DeserializeOwned;

use crate::{
    Affine, Camera, Mesh, Object, Provenance, SceneError, Vec3, Wrap,
    extras::{FORMAT, Keyed, NodeExtras, SceneExtras},
};

use super::{
    ImportOptions, Opener,
    buffers::Buffers,
    complete::{Draft, FileLaser},
    far, format_error,
    image::Images,
    mitsuba::Matrix,
};
use document::Facts;
use parts::{camera_of, laser_of};

/// The deepest nesting of nodes.
const MAX_DEPTH: usize = 1000;
/// The category of nodes without a `label`.
const UNLABELLED: &str = "unlabelled";

/// Reads `.glb` or `.gltf` bytes; the caller validates the result.
pub(super) fn read(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
    files: &Opener,
) -> Result<Draft, SceneError> {
    let (document, buffers, facts) = open(path, bytes, files)?;
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
    let mut walk = Walk::new((path, files), &document, &buffers, &facts)?;
    for (k, label) in labels.iter().enumerate() {
        walk.known_labels.entry(label.clone()).or_insert(k);
    }
    walk.labels = labels;
    if ours.is_none() && options.camera.is_none() {
        walk.move_near_origin(&root);
    }
    walk.walk(&root)?;
    walk.finish(&root, ours)
}

/// Reads `.glb` or `.gltf` bytes as one mesh in the file's own frame, with the notes on dropped
/// parts. Cameras and lasers are ignored; the caller checks the numbers.
pub(super) fn read_model(
    path: &Path,
    bytes: &[u8],
    files: &Opener,
) -> Result<(Mesh, BTreeMap<String, String>), SceneError> {
    let (document, buffers, facts) = open(path, bytes, files)?;
    let mut walk = Walk::new((path, files), &document, &buffers, &facts)?;
    walk.strict = false;
    walk.walk(&root(path, &document)?)?;
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
) -> Result<(gltf::Document, Buffers, Facts), SceneError> {
    let fail = |what: String| format_error(path, what);
    let parsed = document::parse(bytes).map_err(|e| {
        fail(match document::is_version_1(bytes) {
            true => "is glTF 1.0; `gltf-pipeline -i IN -o OUT` converts it to 2.0".into(),
            false => format!("is not readable glTF 2.0 ({e}); copy or export it again"),
        })
    })?;
    let mut parsed = parsed;
    parsed.check().map_err(fail)?;
    let blob = parsed.blob.take();
    let mut buffers = Buffers::read(path, &parsed.root, blob, files)?;
    plain::convert(&mut parsed.root, &mut buffers.0).map_err(fail)?;
    let (document, facts) = parsed.document(bytes).map_err(fail)?;
    Ok((document, buffers, facts))
}

fn root<'a>(path: &Path, document: &'a gltf::Document) -> Result<gltf::Scene<'a>, SceneError> {
    document
        .default_scene()
        .or_else(|| document.scenes().next())
        .ok_or_else(|| format_error(path, "scenes: the file has none; export at least one scene"))
}

/// Checks that every node of the scene has at most one parent there, and that the scene's own nodes
/// have none; otherwise a walk might not end.
fn is_a_forest(
    path: &Path,
    document: &gltf::Document,
    root: &gltf::Scene<'_>,
) -> Result<(), SceneError> {
    let mut parents = vec![0u32; document.nodes().len()];
    let mut open: Vec<Node<'_>> = root.nodes().collect();
    open.iter().for_each(|n| parents[n.index()] += 1);
    // Nodes outside the scene do not count. Each node is opened once.
    while let Some(node) = open.pop() {
        for child in node.children() {
            parents[child.index()] += 1;
            if parents[child.index()] == 1 {
                open.push(child);
            }
        }
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

/// Parses `extras` that contain our key. Returns `None` if they are absent or another program's.
fn keyed<T: DeserializeOwned>(
    path: &Path,
    field: &str,
    raw: Option<&str>,
) -> Result<Option<T>, SceneError> {
    let Some(raw) = under(path, field, raw, "picofarm")? else {
        return Ok(None);
    };
    // Parsed from the text, because a generic JSON value would round f32 numbers twice.
    serde_json::from_str::<Keyed<T>>(raw)
        .map(|k| Some(k.picofarm))
        .map_err(|e| format_error(path, format!("{field}: {e}")))
}

/// Returns the text of `extras` that contain a key, or `None` if they are absent or contain other
/// keys.
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

/// The key of a mesh: its index, and the node if the node deforms the mesh.
type MeshKey = (usize, Option<usize>);

struct Walk<'a> {
    path: &'a Path,
    files: &'a Opener,
    document: &'a gltf::Document,
    buffers: &'a Buffers,
    facts: &'a Facts,
    /// The world transforms by node, in the file's coordinates.
    worlds: Vec<Option<Matrix>>,
    /// The position of the scene's origin in the file's coordinates.
    origin: [f64; 3],
    /// Whether to refuse surfaces that would change their appearance. For models of a library, a
    /// note is added instead.
    strict: bool,
    images: Images<(usize, Wrap)>,
    /// The number of vertices and corners read so far.
    corners: usize,
    /// Whether a point cloud was left out.
    points: bool,
    /// The number of triangles that masks added so far.
    cut_triangles: usize,
    /// The number of vertices and corners of all objects.
    placed: usize,
    meshes: BTreeMap<MeshKey, Option<Arc<Mesh>>>,
    objects: Vec<(Option<u32>, Object)>,
    labels: Vec<String>,
    /// The indices of `labels`.
    known_labels: BTreeMap<String, usize>,
    /// The perspective cameras with their names; an error is reported only if the camera is used.
    cameras: Vec<(String, Result<Camera, String>)>,
    /// The orthographic cameras with their names.
    parallel: Vec<(String, Affine, [f32; 2])>,
    laser: Option<(Affine, NodeExtras)>,
    notes: BTreeMap<String, String>,
}

impl<'a> Walk<'a> {
    fn new(
        (path, files): (&'a Path, &'a Opener),
        document: &'a gltf::Document,
        buffers: &'a Buffers,
        facts: &'a Facts,
    ) -> Result<Self, SceneError> {
        let root = root(path, document)?;
        is_a_forest(path, document, &root)?;
        Ok(Walk {
            path,
            files,
            document,
            buffers,
            facts,
            worlds: nodes::worlds(path, document, &root, facts)?,
            origin: [0.0; 3],
            strict: true,
            images: Images::default(),
            corners: 0,
            points: false,
            cut_triangles: 0,
            placed: 0,
            meshes: BTreeMap::new(),
            objects: Vec::new(),
            labels: Vec::new(),
            known_labels: BTreeMap::new(),
            cameras: Vec::new(),
            parallel: Vec::new(),
            laser: None,
            notes: BTreeMap::new(),
        })
    }

    /// Reads all objects of the document's scene.
    fn walk(&mut self, root: &gltf::Scene<'_>) -> Result<(), SceneError> {
        self.dropped_parts();
        for node in root.nodes() {
            self.node(&node, None, true)?;
        }
        Ok(())
    }

    /// Moves a scene far from the origin of its file to its camera, or to its first mesh without a
    /// camera.
    fn move_near_origin(&mut self, root: &gltf::Scene<'_>) {
        // In the order of the walk.
        let mut open: Vec<Node<'_>> = root.nodes().collect();
        open.reverse();
        let mut mesh = None;
        let mut camera = None;
        while let Some(node) = open.pop() {
            if node.camera().is_some_and(|c| is_perspective(&c)) {
                camera = Some(node.index());
                break;
            }
            if mesh.is_none() && node.mesh().is_some() {
                mesh = Some(node.index());
            }
            let children: Vec<Node<'_>> = node.children().collect();
            open.extend(children.into_iter().rev());
        }
        let Some(node) = camera.or(mesh) else { return };
        let world = self.worlds.get(node).copied().flatten();
        let origin = world.unwrap_or(Matrix::IDENTITY).origin();
        if far::is_lossy(origin, f64::INFINITY) {
            self.origin = origin;
            self.note("origin", far::note(origin));
        }
    }

    /// Converts a transform to the scene's coordinates.
    fn placed(&self, world: &Matrix) -> Matrix {
        match self.origin == [0.0; 3] {
            true => *world,
            false => Matrix::translation(self.origin.map(|x| -x)).after(world),
        }
    }

    /// Returns the index of a label.
    fn label(&mut self, label: &str) -> usize {
        if let Some(known) = self.known_labels.get(label) {
            return *known;
        }
        self.labels.push(label.to_owned());
        let index = self.labels.len() - 1;
        self.known_labels.insert(label.to_owned(), index);
        index
    }

    /// Reads a node. `worlds` has already limited the depth.
    fn node(
        &mut self,
        node: &Node<'_>,
        label: Option<&str>,
        visible: bool,
    ) -> Result<(), SceneError> {
        let world = self.worlds.get(node.index()).copied().flatten();
        let to_world = self.placed(&world.unwrap_or(Matrix::IDENTITY));
        let extras = self.extras(node)?;
        let label = extras.label.as_deref().or(label);
        let visible = visible && !nodes::is_hidden(node);
        if let Some(mesh) = node.mesh() {
            match visible {
                true => self.object(node, &mesh, &to_world, label, extras.instance)?,
                false => self.note("hidden", "meshes of nodes that are not visible left out"),
            }
        }
        if let Some(camera) = node.camera() {
            let name = node.name().or(camera.name()).unwrap_or_default().to_owned();
            match camera.projection() {
                Projection::Orthographic(lens) => {
                    let half = [lens.xmag().abs(), lens.ymag().abs()];
                    self.parallel.push((name, to_world.affine(), half));
                }
                Projection::Perspective(_) => {
                    let read = camera_of(&to_world.affine(), &camera);
                    self.cameras.push((name, read));
                }
            }
        }
        if self.laser.is_none()
            && (extras.laser_spots.is_some() || extras.laser_directions.is_some())
        {
            self.laser = Some((to_world.affine(), extras.clone()));
        }
        for child in node.children() {
            self.node(&child, label, visible)?;
        }
        Ok(())
    }

    fn object(
        &mut self,
        node: &Node<'_>,
        mesh: &gltf::Mesh<'_>,
        to_world: &Matrix,
        label: Option<&str>,
        instance: Option<u32>,
    ) -> Result<(), SceneError> {
        let deformation = self.deformation(node, mesh)?;
        let own = (!deformation.is_none()).then(|| node.index());
        let key = (mesh.index(), own);
        let shared = match self.meshes.get(&key) {
            Some(known) => known.clone(),
            None => {
                let read = self.mesh(mesh, &deformation)?.map(Arc::new);
                self.meshes.insert(key, read.clone());
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
        let label = u16::try_from(self.label(label)).map_err(|_| {
            format_error(
                self.path,
                "nodes[].extras.label: more than 65535 categories",
            )
        })?;
        for place in self.instances(node)? {
            self.placed += shared.positions.len() + shared.triangles.len();
            if self.placed > mesh::MAX_CORNERS {
                let what = format!(
                    "nodes[{}]: more than {} vertices and triangles in all objects; split the scene",
                    node.index(),
                    mesh::MAX_CORNERS
                );
                return Err(format_error(self.path, what));
            }
            // A skin determines the vertices from its joints, whatever the transform of the mesh's
            // node.
            let to_world = match deformation.is_skinned() {
                true => Affine::IDENTITY,
                false => to_world.after(&place).affine(),
            };
            self.objects.push((
                instance,
                Object {
                    mesh: shared.clone(),
                    to_world,
                    label,
                    name: node.name().or(mesh.name()).unwrap_or("object").to_owned(),
                },
            ));
        }
        Ok(())
    }

    fn finish(
        mut self,
        root: &gltf::Scene<'_>,
        ours: Option<SceneExtras>,
    ) -> Result<Draft, SceneError> {
        let path = self.path;
        if let Some(what) = self.why_empty() {
            return Err(format_error(path, what));
        }
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
        self.parallel_cameras();
        let (cameras, laser, mut provenance, name) = match ours {
            Some(e) => (
                vec![(String::new(), Ok(e.camera))],
                Some(FileLaser::Beams(e.laser)),
                e.provenance,
                e.name,
            ),
            None => {
                let laser = self.laser.as_ref();
                let laser = laser.map(|(to_world, extras)| laser_of(path, to_world, extras));
                let provenance = Provenance {
                    source: "gltf".into(),
                    ..Provenance::default()
                };
                let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
                let name = root.name().map(str::to_owned).or(stem).unwrap_or_default();
                (self.cameras, laser.transpose()?, provenance, name)
            }
        };
        for (key, note) in self.notes {
            provenance.notes.insert(format!("import.{key}"), note);
        }
        Ok(Draft {
            name,
            objects: self.objects.into_iter().map(|(_, object)| object).collect(),
            labels: self.labels,
            cameras,
            laser,
            has_unit: true,
            provenance,
        })
    }
}

fn is_perspective(camera: &gltf::Camera<'_>) -> bool {
    matches!(camera.projection(), Projection::Perspective(_))
}
