//! Reconstructions of scenes: a separate folder in a store, next to the data set with the scenes.
//! Each scene has `scenes/<scene>/` with `density.zarr` (a Zarr v3 group), `mesh.glb`, `mesh.ply`
//! and `metrics.json`.
//!
//! They are published like scenes: objects first, `manifests/<scene>.json` last, all create-only
//! and pure functions of the task. A long-running task stores checkpoints in `checkpoints/<task
//! key>/` until then.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checkpoints::Checkpoints;
use crate::predictions::SceneUsed;
use picofarm_dataset::{METADATA, pretty};
use picofarm_store::objects;
use picofarm_store::published::{Manifest, Published};
use picofarm_store::sealed::{document, read_sealed, same_scene};
use picofarm_store::{ObjectEntry, StorageError, Verification, VerifyMode, Watch};

/// Format version of these folders and their manifests.
const FORMAT: u32 = 1;

/// The contents of a reconstruction. It is a pure function of the task, without times or machine
/// names.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ReconstructionManifest {
    /// Format version of the manifest. Set on publishing.
    pub format: u32,
    /// Scene index, equal to the source scene's.
    pub scene: u64,
    /// Key of the task that produced it: scene, predictions, settings and code.
    pub task_key: String,
    /// Code version of the reconstruction.
    pub code: String,
    /// The source scene.
    pub source: SceneUsed,
    /// The predictions used, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predictions: Option<SceneUsed>,
    /// Settings of the reconstruction.
    pub settings: Value,
    /// Its objects. Set on publishing.
    pub objects: Vec<ObjectEntry>,
    /// Checksum of the other fields, from `picofarm_store::sealed::seal`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

impl Manifest for ReconstructionManifest {
    type Id = u64;

    fn parse(bytes: &[u8], scene: &u64, object: &str) -> Result<Self, StorageError> {
        let manifest: Self = read_sealed(bytes, "a reconstruction's manifest", FORMAT, object)?;
        same_scene(manifest.scene, *scene, object)?;
        Ok(manifest)
    }

    fn to_bytes(&self) -> Vec<u8> {
        document(self)
    }

    fn objects(&self) -> &[ObjectEntry] {
        &self.objects
    }

    fn task_key(&self) -> &str {
        &self.task_key
    }

    fn taken(&self, place: &str, task_key: &str) -> StorageError {
        let what = format!(
            "{place} holds another reconstruction of scene {} (task key {}, this task's is {task_key}): of other measurements or \
             settings; choose another folder",
            self.scene, self.task_key
        );
        StorageError::invalid("output.dataset", what)
    }
}

/// Reconstructions in a store. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Reconstructions(Published<ReconstructionManifest>);

impl Reconstructions {
    /// Creates the folder at `prefix`, or opens an existing one.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the location contains something else; [`StorageError::Store`].
    pub async fn create_or_open(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
    ) -> Result<Self, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let ours = pretty(&json!({
            "zarr_format": 3,
            "node_type": "group",
            "attributes": {
                "picofarm": {"reconstructions": FORMAT},
                "made_of": "manifests/<scene>.json names the scene, its objects lie in scenes/<scene>/",
            },
        }));
        if objects::get(&*store, &root).await?.is_none() {
            // Another worker may create it first.
            objects::create(&*store, &root, ours).await?;
        }
        Self::open(store, prefix).await
    }

    /// Opens the folder at `prefix`.
    ///
    /// # Errors
    /// [`StorageError::NoDataset`]; [`StorageError::Invalid`] if the location contains something
    /// else; [`StorageError::Store`].
    pub async fn open(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Self, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let shown = || objects::shown(&*store, &root);
        let Some(bytes) = objects::get(&*store, &root).await? else {
            return Err(StorageError::NoDataset {
                prefix: objects::shown(&*store, &prefix),
            });
        };
        let found: Value = serde_json::from_slice(&bytes).map_err(|e| StorageError::Damaged {
            object: shown(),
            what: format!("not JSON ({e}), so no Zarr group"),
        })?;
        match found["attributes"]["picofarm"]["reconstructions"].as_u64() {
            Some(format) if format <= u64::from(FORMAT) => Ok(Self(Published::new(store, prefix))),
            Some(format) => Err(StorageError::invalid(
                shown(),
                format!(
                    "written in format {format}, this program knows formats up to {FORMAT}: use a newer one"
                ),
            )),
            None => Err(StorageError::invalid(
                shown(),
                "is a data set or another Zarr group, and no reconstructions; choose another folder for them",
            )),
        }
    }

    /// Returns their location for messages.
    pub fn place(&self) -> String {
        self.0.shown(self.0.folder())
    }

    /// Returns the scenes with a published reconstruction, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, StorageError> {
        self.0.list().await
    }

    /// Returns the manifest of a scene's reconstruction.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<ReconstructionManifest, StorageError> {
        self.0.scene(scene).await
    }

    /// Returns the checkpoints of a reconstruction task.
    pub fn checkpoints_of(&self, task_key: &str) -> Checkpoints {
        Checkpoints::new(self.0.store().clone(), self.0.folder(), task_key)
    }

    /// Reads one of a scene's objects, by its name in the scene's folder, and checks it against the
    /// manifest.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn read(&self, scene: u64, name: &str) -> Result<Bytes, StorageError> {
        let manifest = self.manifest(scene).await?;
        let key = key(scene, name);
        let Some(entry) = manifest.objects.iter().find(|o| o.key == key) else {
            return Err(StorageError::NotPublished {
                scene,
                object: self.0.shown(&self.0.object_path(&scene, &key)),
            });
        };
        self.0.read(&scene, entry).await
    }

    /// Returns the manifest of a scene that this task has published, after checking the SHA-256 of
    /// each object. Returns `None` if the scene is not published.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if another task has published it; [`StorageError::Damaged`] if an
    /// object is missing or changed ([`Self::restore`] repairs it); [`StorageError::Store`].
    pub async fn finished(
        &self,
        scene: u64,
        task_key: &str,
    ) -> Result<Option<ReconstructionManifest>, StorageError> {
        self.0.finished(&scene, task_key, VerifyMode::Full).await
    }

    /// Publishes a scene's reconstruction, or restores its missing or changed objects. `files` are
    /// named relative to the scene's folder. The manifest's format, objects and checksum are set
    /// here.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object exists with different bytes;
    /// [`StorageError::Diverged`] if the result differs from the manifest's;
    /// [`StorageError::Damaged`] if nothing proves the original content; [`StorageError::Store`].
    pub async fn restore(
        &self,
        manifest: ReconstructionManifest,
        files: BTreeMap<String, Bytes>,
    ) -> Result<ReconstructionManifest, StorageError> {
        let scene = manifest.scene;
        let entry = |(name, bytes): (&String, &Bytes)| ObjectEntry::new(key(scene, name), bytes);
        let mut ours = ReconstructionManifest {
            format: FORMAT,
            objects: files.iter().map(entry).collect(),
            checksum: None,
            ..manifest
        };
        ours.checksum = Some(ours.sha256());
        let bytes: Vec<Bytes> = files.into_values().collect();
        self.0.restore(&scene, &ours, &bytes).await?;
        Ok(ours)
    }

    /// Checks the published reconstructions. `watch` is called with the number of checked scenes
    /// and of all scenes.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn verify(
        &self,
        mode: VerifyMode,
        watch: Watch<'_>,
    ) -> Result<Verification, StorageError> {
        self.0.verify(mode, &(), watch).await
    }
}

fn key(scene: u64, name: &str) -> String {
    format!("scenes/{scene}/{name}")
}
