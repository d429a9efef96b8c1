//! Reconstructions of scenes: a folder of their own in a store, beside the data set whose scenes they are. Each scene has
//! `scenes/<scene>/` with `density.zarr` (a Zarr v3 group), `mesh.glb`, `mesh.ply` and `metrics.json`.
//!
//! They are published as scenes are: objects first, `manifests/<scene>.json` last, all create-only and pure functions of the
//! task. A task that runs for long keeps `checkpoints/<task key>/` until then.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checkpoints::Checkpoints;
use crate::error::DatasetError;
use crate::layout::group::{METADATA, pretty};
use crate::layout::manifest::{Manifest, ObjectEntry, read_sealed, sha256_hex};
use crate::layout::published::scenes_in;
use crate::predictions::SceneUsed;
use crate::repair::put_back::put_back;
use crate::store::many::{CONCURRENCY, put_again, put_all};
use crate::store::objects;
use crate::verify::object::{intact, looked_at};
use crate::verify::report::{Fault, Problem, Verification, VerifyMode, Watch};

/// Version of these folders and of their manifests.
const FORMAT: u32 = 1;

/// What a reconstruction is. A pure function of the task: no times, no machine.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ReconstructionManifest {
    /// Version of this form; filled in.
    pub format: u32,
    /// Scene index, that of the source's scene.
    pub scene: u64,
    /// Key of the task that made it: scene, predictions, settings and code.
    pub task_key: String,
    /// Version of the reconstruction.
    pub code: String,
    /// The scene.
    pub source: SceneUsed,
    /// What was predicted of it, where that was used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predictions: Option<SceneUsed>,
    /// Settings.
    pub settings: Value,
    /// Its objects; filled in.
    pub objects: Vec<ObjectEntry>,
    /// What [`crate::layout::manifest::seal`] says of the rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

impl ReconstructionManifest {
    /// Size of all objects together.
    pub fn total_bytes(&self) -> u64 {
        self.objects.iter().map(|o| o.size).sum()
    }

    /// SHA-256 of its bytes as they lie in the store, hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }

    /// The manifest as it lies in the store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).expect("a manifest has only string keys");
        bytes.push(b'\n');
        bytes
    }

    fn parse(bytes: &[u8], scene: u64, object: &str) -> Result<Self, DatasetError> {
        let manifest: Self = read_sealed(bytes, "a reconstruction's manifest", FORMAT, object)?;
        if manifest.scene != scene {
            return Err(DatasetError::Damaged {
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
    /// Creates the folder at `prefix`, or opens it if it is there.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where something else lies there; [`DatasetError::Store`].
    pub async fn create_or_open(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
    ) -> Result<Self, DatasetError> {
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
            // Another worker may be faster.
            objects::create(&*store, &root, ours).await?;
        }
        Self::open(store, prefix).await
    }

    /// Opens the folder at `prefix`.
    ///
    /// # Errors
    /// [`DatasetError::NoDataset`]; [`DatasetError::Invalid`] where something else lies there; [`DatasetError::Store`].
    pub async fn open(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Self, DatasetError> {
        let root = objects::path_of(&prefix, METADATA);
        let shown = || objects::shown(&*store, &root);
        let Some(bytes) = objects::get(&*store, &root).await? else {
            return Err(DatasetError::NoDataset {
                prefix: objects::shown(&*store, &prefix),
            });
        };
        let found: Value = serde_json::from_slice(&bytes).map_err(|e| DatasetError::Damaged {
            object: shown(),
            what: format!("not JSON ({e}), so no Zarr group"),
        })?;
        match found["attributes"]["picofarm"]["reconstructions"].as_u64() {
            Some(format) if format <= u64::from(FORMAT) => Ok(Self { store, prefix }),
            Some(format) => Err(DatasetError::invalid(
                shown(),
                format!(
                    "written in format {format}, this program knows formats up to {FORMAT}: use a newer one"
                ),
            )),
            None => Err(DatasetError::invalid(
                shown(),
                "is a data set or another Zarr group, and no reconstructions; choose another folder for them",
            )),
        }
    }

    /// Where they lie, for a message.
    pub fn place(&self) -> String {
        self.shown(&self.prefix)
    }

    /// The scenes whose reconstructions are published, ascending.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, DatasetError> {
        scenes_in(&*self.store, &self.path("manifests")).await
    }

    /// The manifest of a scene's reconstruction.
    ///
    /// # Errors
    /// [`DatasetError::NotPublished`], [`DatasetError::Damaged`], [`DatasetError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<ReconstructionManifest, DatasetError> {
        let path = self.path(&Manifest::key(scene));
        match objects::get(&*self.store, &path).await? {
            Some(bytes) => ReconstructionManifest::parse(&bytes, scene, &self.shown(&path)),
            None => Err(DatasetError::NotPublished {
                scene,
                object: self.shown(&path),
            }),
        }
    }

    /// The checkpoints of a task that makes one of a scene.
    pub fn checkpoints_of(&self, task_key: &str) -> Checkpoints {
        Checkpoints::new(self.store.clone(), &self.prefix, task_key)
    }

    /// One of a scene's objects, by its name below the scene's folder, checked against its manifest.
    ///
    /// # Errors
    /// [`DatasetError::NotPublished`], [`DatasetError::Damaged`], [`DatasetError::Store`].
    pub async fn read(&self, scene: u64, name: &str) -> Result<Bytes, DatasetError> {
        let manifest = self.manifest(scene).await?;
        let key = key(scene, name);
        let path = self.path(&key);
        let Some(entry) = manifest.objects.iter().find(|o| o.key == key) else {
            return Err(DatasetError::NotPublished {
                scene,
                object: self.shown(&path),
            });
        };
        self.intact(entry).await
    }

    /// The manifest of a scene that this very task has published, after checking that each of its objects has the stated
    /// SHA-256. `None` where it is not published.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where another task has published it; [`DatasetError::Damaged`] where an object is missing or
    /// changed ([`Self::restore`] puts it back); [`DatasetError::Store`].
    pub async fn finished(
        &self,
        scene: u64,
        task_key: &str,
    ) -> Result<Option<ReconstructionManifest>, DatasetError> {
        let manifest = match self.manifest(scene).await {
            Ok(manifest) => manifest,
            Err(DatasetError::NotPublished { .. }) => return Ok(None),
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

    /// Publishes a scene's reconstruction, or puts back what is missing or changed of it. `files` by their names below the
    /// scene's folder; the manifest's format, objects and checksum are filled in.
    ///
    /// # Errors
    /// [`DatasetError::Conflict`] where an object exists with other bytes; [`DatasetError::Diverged`] where another one came
    /// out than the manifest says; [`DatasetError::Damaged`] where nothing proves what was there; [`DatasetError::Store`].
    pub async fn restore(
        &self,
        manifest: ReconstructionManifest,
        files: BTreeMap<String, Bytes>,
    ) -> Result<ReconstructionManifest, DatasetError> {
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
                return Err(DatasetError::Diverged {
                    object: self.shown(&path),
                    expected: sha256_hex(&stored),
                    ours: ours.sha256(),
                });
            }
        }
        put_back(&*self.store, (path, bytes), readable, &objects).await?;
        Ok(ours)
    }

    /// Refuses what another task has published.
    fn check_owner(
        &self,
        found: &ReconstructionManifest,
        task_key: &str,
    ) -> Result<(), DatasetError> {
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
        Err(DatasetError::invalid("output.dataset", what))
    }

    async fn intact(&self, object: &ObjectEntry) -> Result<Bytes, DatasetError> {
        intact(&*self.store, &self.path(&object.key), object).await
    }

    /// Checks what is published. `watch` hears how many scenes are checked of how many.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn verify(
        &self,
        mode: VerifyMode,
        watch: Watch<'_>,
    ) -> Result<Verification, DatasetError> {
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
                Err(DatasetError::Damaged { object, what }) => {
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
