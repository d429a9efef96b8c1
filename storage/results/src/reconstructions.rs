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
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checkpoints::Checkpoints;
use crate::predictions::SceneUsed;
use picofarm_dataset::Manifest;
use picofarm_dataset::{METADATA, pretty};
use picofarm_store::StorageError;
use picofarm_store::many::{CONCURRENCY, put_again, put_all};
use picofarm_store::objects;
use picofarm_store::published::scenes_in;
use picofarm_store::put_back::put_back;
use picofarm_store::sealed::{ObjectEntry, read_sealed, sha256_hex};
use picofarm_store::verify::{intact, looked_at};
use picofarm_store::{Fault, Problem, Verification, VerifyMode, Watch};

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
    /// Checksum of the other fields, from `layout::manifest::seal`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

impl ReconstructionManifest {
    /// Returns the total size of all objects in bytes.
    pub fn total_bytes(&self) -> u64 {
        self.objects.iter().map(|o| o.size).sum()
    }

    /// Returns the SHA-256 of its stored bytes, in hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }

    /// Returns the bytes to store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).expect("a manifest has only string keys");
        bytes.push(b'\n');
        bytes
    }

    fn parse(bytes: &[u8], scene: u64, object: &str) -> Result<Self, StorageError> {
        let manifest: Self = read_sealed(bytes, "a reconstruction's manifest", FORMAT, object)?;
        if manifest.scene != scene {
            return Err(StorageError::Damaged {
                object: object.to_owned(),
                what: format!("holds scene {}, not {scene}", manifest.scene),
            });
        }
        Ok(manifest)
    }
}

/// Reconstructions in a store. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Reconstructions {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
}

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
            Some(format) if format <= u64::from(FORMAT) => Ok(Self { store, prefix }),
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
        self.shown(&self.prefix)
    }

    /// Returns the scenes with a published reconstruction, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, StorageError> {
        scenes_in(&*self.store, &self.path("manifests")).await
    }

    /// Returns the manifest of a scene's reconstruction.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<ReconstructionManifest, StorageError> {
        let path = self.path(&Manifest::key(scene));
        match objects::get(&*self.store, &path).await? {
            Some(bytes) => ReconstructionManifest::parse(&bytes, scene, &self.shown(&path)),
            None => Err(StorageError::NotPublished {
                scene,
                object: self.shown(&path),
            }),
        }
    }

    /// Returns the checkpoints of a reconstruction task.
    pub fn checkpoints_of(&self, task_key: &str) -> Checkpoints {
        Checkpoints::new(self.store.clone(), &self.prefix, task_key)
    }

    /// Reads one of a scene's objects, by its name in the scene's folder, and checks it against the
    /// manifest.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn read(&self, scene: u64, name: &str) -> Result<Bytes, StorageError> {
        let manifest = self.manifest(scene).await?;
        let key = key(scene, name);
        let path = self.path(&key);
        let Some(entry) = manifest.objects.iter().find(|o| o.key == key) else {
            return Err(StorageError::NotPublished {
                scene,
                object: self.shown(&path),
            });
        };
        self.intact(entry).await
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
        let manifest = match self.manifest(scene).await {
            Ok(manifest) => manifest,
            Err(StorageError::NotPublished { .. }) => return Ok(None),
            Err(error) => return Err(error),
        };
        self.check_owner(&manifest, task_key)?;
        let objects = manifest.objects.iter();
        let mut checks =
            stream::iter(objects.map(|o| self.intact(o))).buffer_unordered(CONCURRENCY);
        while checks.try_next().await?.is_some() {}
        drop(checks);
        Ok(Some(manifest))
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
        let entry = |(name, bytes): (&String, &Bytes)| ObjectEntry {
            key: key(scene, name),
            size: bytes.len() as u64,
            sha256: sha256_hex(bytes),
        };
        let mut ours = ReconstructionManifest {
            format: FORMAT,
            objects: files.iter().map(entry).collect(),
            checksum: None,
            ..manifest
        };
        ours.checksum = Some(ours.sha256());
        let paths = ours.objects.iter().map(|o| self.path(&o.key));
        let objects: Vec<(Path, Bytes)> = paths.zip(files.into_values()).collect();
        let path = self.path(&Manifest::key(scene));
        let bytes = Bytes::from(ours.to_bytes());
        let Some(stored) = objects::get(&*self.store, &path).await? else {
            put_all(&*self.store, &objects).await?;
            objects::create_or_match(&*self.store, &path, bytes).await?;
            put_again(&*self.store, &objects).await?;
            return Ok(ours);
        };
        let theirs = ReconstructionManifest::parse(&stored, scene, &self.shown(&path)).ok();
        let readable = theirs.is_some();
        if let Some(theirs) = theirs {
            self.check_owner(&theirs, &ours.task_key)?;
            if stored != bytes {
                return Err(StorageError::Diverged {
                    object: self.shown(&path),
                    expected: sha256_hex(&stored),
                    ours: ours.sha256(),
                });
            }
        }
        put_back(&*self.store, (path, bytes), readable, &objects).await?;
        Ok(ours)
    }

    /// Returns an error if another task has published this reconstruction.
    fn check_owner(
        &self,
        found: &ReconstructionManifest,
        task_key: &str,
    ) -> Result<(), StorageError> {
        if found.task_key == task_key {
            return Ok(());
        }
        let what = format!(
            "{} holds another reconstruction of scene {} (task key {}, this task's is {task_key}): of other measurements or \
             settings; choose another folder",
            self.place(),
            found.scene,
            found.task_key
        );
        Err(StorageError::invalid("output.dataset", what))
    }

    async fn intact(&self, object: &ObjectEntry) -> Result<Bytes, StorageError> {
        intact(&*self.store, &self.path(&object.key), object).await
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
        let mut report = Verification::default();
        let present = self.scenes_present().await?;
        for scene in &present {
            let problem = |object: String, fault| Problem {
                object,
                scene: Some(*scene),
                fault,
            };
            report.scenes += 1;
            let manifest = match self.manifest(*scene).await {
                Ok(manifest) => manifest,
                Err(StorageError::Damaged { object, what }) => {
                    report
                        .problems
                        .push(problem(object, Fault::BadManifest(what)));
                    continue;
                }
                Err(error) => return Err(error),
            };
            for entry in &manifest.objects {
                let path = self.path(&entry.key);
                report.objects += 1;
                report.bytes += entry.size;
                if let Err(fault) = looked_at(&*self.store, &path, entry, mode).await? {
                    report.problems.push(problem(self.shown(&path), fault));
                }
            }
            watch(report.scenes, present.len() as u64);
        }
        Ok(report)
    }

    fn path(&self, key: &str) -> Path {
        objects::path_of(&self.prefix, key)
    }

    fn shown(&self, path: &Path) -> String {
        objects::shown(&*self.store, path)
    }
}

fn key(scene: u64, name: &str) -> String {
    format!("scenes/{scene}/{name}")
}
