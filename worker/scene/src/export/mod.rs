//! Writes scenes: as canonical `.glb` (one binary glTF 2.0 file that any viewer opens and that
//! [`crate::import`] reads back exactly), for Mitsuba 3, or as one PLY mesh. The same scene gives
//! the same bytes.

mod binary;
mod document;
pub(crate) mod mitsuba;
mod normals;
mod ply;
mod textures;

use std::{
    io::Write,
    path::{Path, PathBuf},
    sync::Arc,
};

use picofarm_figures::rgb_png;

use crate::{Mesh, Scene, SceneError, Texture};
use document::Document;
pub use mitsuba::write_mitsuba;
use normals::Normals;

const GLB_MAGIC: u32 = 0x4654_6c67;
const GLB_VERSION: u32 = 2;
const CHUNK_JSON: u32 = 0x4e4f_534a;
const CHUNK_BIN: u32 = 0x004e_4942;

/// Returns the canonical `.glb` bytes of a scene. Meshes shared by several objects are stored once.
/// Triangles are grouped by material, otherwise in their order.
///
/// # Errors
/// [`SceneError::Invalid`] for a scene that fails [`Scene::validate`] or would exceed glTF's 4 GiB.
pub fn glb_bytes(scene: &Scene) -> Result<Vec<u8>, SceneError> {
    glb(scene, Normals::Flat)
}

/// Like [`glb_bytes`], with a normal at each vertex, so that viewers shade curved surfaces
/// smoothly. [`crate::import`] does not read normals, so it reads the same scene.
///
/// # Errors
/// As for [`glb_bytes`].
pub fn glb_bytes_with_normals(scene: &Scene) -> Result<Vec<u8>, SceneError> {
    glb(scene, Normals::Smooth)
}

fn glb(scene: &Scene, normals: Normals) -> Result<Vec<u8>, SceneError> {
    scene.validate()?;
    if let Some(i) = scene
        .objects
        .iter()
        .position(|o| o.mesh.triangles.is_empty())
    {
        return Err(SceneError::Invalid {
            scene: scene.name.clone(),
            field: format!("objects[{i}] ({})", scene.objects[i].name),
            what: "has no triangles, which glTF cannot hold; remove the object".into(),
        });
    }
    let mut meshes: Vec<Arc<Mesh>> = Vec::new();
    let mesh_of: Vec<usize> = scene
        .objects
        .iter()
        .map(|object| {
            let known = meshes.iter().position(|m| Arc::ptr_eq(m, &object.mesh));
            known.unwrap_or_else(|| {
                meshes.push(object.mesh.clone());
                meshes.len() - 1
            })
        })
        .collect();
    let (document, binary) = Document::new(scene, &meshes, &mesh_of, normals);
    let invalid = |what: String| SceneError::Invalid {
        scene: scene.name.clone(),
        field: "glb".into(),
        what,
    };
    let mut json = serde_json::to_vec(&document)
        .map_err(|e| invalid(format!("cannot be written as JSON: {e}")))?;
    json.resize(json.len().next_multiple_of(4), b' ');

    let length = 12 + 8 + json.len() + 8 + binary.len();
    let word = |n: usize| {
        u32::try_from(n).map(u32::to_le_bytes).map_err(|_| {
            invalid(format!(
                "{n} bytes exceed the 4 GiB of a .glb; use fewer triangles"
            ))
        })
    };
    let mut out = Vec::with_capacity(length);
    out.extend(GLB_MAGIC.to_le_bytes());
    out.extend(GLB_VERSION.to_le_bytes());
    out.extend(word(length)?);
    for (kind, chunk) in [(CHUNK_JSON, &json), (CHUNK_BIN, &binary)] {
        out.extend(word(chunk.len())?);
        out.extend(kind.to_le_bytes());
        out.extend(chunk);
    }
    Ok(out)
}

/// Writes the canonical `.glb` to `path`. It writes a temporary file in the same folder first and
/// then renames it, so that a reader never sees an incomplete scene.
///
/// # Errors
/// As for [`glb_bytes`], and [`SceneError::Write`] naming the file.
pub fn write_glb(scene: &Scene, path: &Path) -> Result<(), SceneError> {
    write_whole(path, &glb_bytes(scene)?)
}

/// Writes the whole scene as one PLY mesh in world space, for programs that only use shapes: faces
/// have their sRGB colour and the index of their object (`instance`). Camera, laser, BSDFs and
/// textures are omitted.
///
/// # Errors
/// As for [`write_glb`]; [`SceneError::Invalid`] also for more than 2³² vertices.
pub fn write_ply(scene: &Scene, path: &Path) -> Result<(), SceneError> {
    scene.validate()?;
    let vertices: usize = scene.objects.iter().map(|o| o.mesh.positions.len()).sum();
    if u32::try_from(vertices).is_err() {
        return Err(SceneError::Invalid {
            scene: scene.name.clone(),
            field: "ply".into(),
            what: format!("{vertices} vertices exceed the 2³² of a PLY; use fewer"),
        });
    }
    write_whole(path, &ply::scene_bytes(scene))
}

/// Writes a file so that it appears completely or not at all.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), SceneError> {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".{}.partial", std::process::id()));
    let partial: PathBuf = path.with_file_name(name);
    let written = std::fs::File::create(&partial)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&partial, path));
    written.map_err(|source| {
        // The partial file belongs to this function only; the first error is the one to report.
        let _ = std::fs::remove_file(&partial);
        SceneError::Write {
            path: path.to_path_buf(),
            source,
        }
    })
}

/// Encodes a texture as 8-bit RGB PNG.
fn png(texture: &Texture) -> Vec<u8> {
    let texels = texture.texels().as_flattened();
    rgb_png(texture.width(), texture.height(), texels)
}
