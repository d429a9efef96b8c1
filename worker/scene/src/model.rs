//! A whole scene, with placed objects, a camera, a laser and its provenance; and its validation.

use std::{collections::BTreeMap, path::PathBuf, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::{Affine, Camera, Laser, Mesh, body};

/// A mesh placed in the world. Its index in [`Scene::objects`] is its instance id.
#[derive(Debug, Clone)]
pub struct Object {
    /// The shared geometry.
    pub mesh: Arc<Mesh>,
    /// The map from mesh frame to world.
    pub to_world: Affine,
    /// The category, an index into [`Scene::labels`].
    pub label: u16,
    /// The name, for people.
    pub name: String,
}

/// The origin of a scene, which is stored with every histogram.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// The generator or importer with its version, e.g. `furnished-2`, `gltf`.
    pub source: String,
    /// The seed of a generator.
    pub seed: Option<u64>,
    /// The attribution lines of the assets used (creator, licence).
    pub attribution: Vec<String>,
    /// Free-form facts (room type, size, parts dropped on import, …).
    pub notes: BTreeMap<String, String>,
}

/// The input of the renderer, in world space.
#[derive(Debug, Clone)]
pub struct Scene {
    /// The name, for people.
    pub name: String,
    /// The placed objects; the index is the instance id.
    pub objects: Vec<Object>,
    /// The category names, which [`Object::label`] indexes. Generated scenes have a fixed
    /// vocabulary.
    pub labels: Vec<String>,
    /// The camera.
    pub camera: Camera,
    /// The laser and its beams.
    pub laser: Laser,
    /// The scene's origin.
    pub provenance: Provenance,
}

/// The reason why a scene cannot be read, generated or used.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file cannot be read.
    #[error("cannot read {path}: {source}; check that the file exists and is readable")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A scene file names a file outside the allowed folders.
    #[error(transparent)]
    Refused(picofarm_files::FileError),
    /// A file cannot be written.
    #[error("cannot write {path}: {source}; check the folder, its permissions and the free space")]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file's content violates its format.
    #[error("{path}: {what}")]
    Format {
        /// The file.
        path: PathBuf,
        /// The field, the expected and actual values, and how to correct it.
        what: String,
    },
    /// A scene's content cannot be used, whatever its source.
    #[error("scene {scene:?}: {field}: {what}")]
    Invalid {
        /// The scene's name.
        scene: String,
        /// The field, e.g. `objects[3].mesh.positions[17]`.
        field: String,
        /// The fault, the expected values, and how to correct it.
        what: String,
    },
    /// A generator exhausted its attempts.
    #[error(
        "generator {generator} found no acceptable scene for seed {seed} in {attempts} attempts; use another seed"
    )]
    Exhausted {
        /// The generator.
        generator: String,
        /// The seed.
        seed: u64,
        /// The number of attempts.
        attempts: u32,
    },
    /// The furniture assets that the job names are not installed.
    #[error("assets {name:?} are not installed ({looked}); {hint}, or set assets = \"parametric\"")]
    Assets {
        /// The asset source.
        name: String,
        /// The places that were searched.
        looked: String,
        /// How to obtain the assets.
        hint: &'static str,
    },
    /// Furniture assets cannot be downloaded.
    #[error("assets cannot be installed: {what}")]
    Install {
        /// The failure, and an alternative.
        what: String,
    },
}

impl Scene {
    /// Returns the number of triangles over all placed objects.
    pub fn triangle_count(&self) -> usize {
        self.objects.iter().map(|o| o.mesh.triangles.len()).sum()
    }

    /// Checks the renderer's requirements: finite vertices, valid indices, materials within their
    /// physical limits, glass bodies closed and facing outwards as placed, an orthonormal camera,
    /// and unit beams.
    ///
    /// # Errors
    /// [`SceneError::Invalid`] naming the first invalid field.
    pub fn validate(&self) -> Result<(), SceneError> {
        let bad = |field: String, what: String| {
            Err(SceneError::Invalid {
                scene: self.name.clone(),
                field,
                what,
            })
        };
        for (i, object) in self.objects.iter().enumerate() {
            let (mesh, at) = (&object.mesh, format!("objects[{i}] ({})", object.name));
            if usize::from(object.label) >= self.labels.len() {
                return bad(at, format!("label {} has no name in labels", object.label));
            }
            for (k, p) in mesh.positions.iter().enumerate() {
                if !object.to_world.point(*p).is_finite() {
                    return bad(
                        format!("{at}.positions[{k}]"),
                        format!("vertex {p:?} is not finite; repair or remove the mesh"),
                    );
                }
            }
            if mesh.triangle_material.len() != mesh.triangles.len() {
                return bad(at, "needs one material index per triangle".into());
            }
            for (k, t) in mesh.triangles.iter().enumerate() {
                if t.iter().any(|&v| v as usize >= mesh.positions.len()) {
                    return bad(
                        format!("{at}.triangles[{k}]"),
                        format!("{t:?} points past {} vertices", mesh.positions.len()),
                    );
                }
                if mesh.triangle_material[k] as usize >= mesh.materials.len() {
                    return bad(
                        format!("{at}.triangle_material[{k}]"),
                        format!("no such material among {}", mesh.materials.len()),
                    );
                }
            }
            for m in &mesh.materials {
                if let Err(what) = m.check() {
                    return bad(format!("{at}.materials[{}]", m.name), what);
                }
                if m.texture.is_some() && mesh.uv.is_empty() {
                    return bad(
                        format!("{at}.materials[{}].texture", m.name),
                        "the mesh has no texture coordinates; export it with them, or drop the texture".into(),
                    );
                }
            }
            if !mesh.uv.is_empty() && mesh.uv.len() != mesh.positions.len() {
                return bad(
                    format!("{at}.uv"),
                    format!(
                        "{} texture coordinates for {} vertices; give one a vertex, or none",
                        mesh.uv.len(),
                        mesh.positions.len()
                    ),
                );
            }
            if let Some(k) = mesh
                .uv
                .iter()
                .position(|uv| !uv.iter().all(|x| x.is_finite()))
            {
                return bad(
                    format!("{at}.uv[{k}]"),
                    format!(
                        "{:?} is not finite; repair the texture coordinates",
                        mesh.uv[k]
                    ),
                );
            }
        }
        if let Err((field, what)) = body::check(&self.objects) {
            return bad(field, what);
        }
        if let Err((field, what)) = self.camera.check() {
            return bad(field, what);
        }
        for (i, b) in self.laser.beams.iter().enumerate() {
            if !b.direction.is_finite() || (b.direction.length() - 1.0).abs() > 1e-4 {
                return bad(
                    format!("laser.beams[{i}].direction"),
                    format!("{:?} is not a unit vector", b.direction),
                );
            }
        }
        if !self.laser.origin.is_finite() {
            return bad("laser.origin".into(), "is not finite".into());
        }
        Ok(())
    }
}
