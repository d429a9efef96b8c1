//! Reports about models: `reports/<name>/` in a store, beside its data sets and models: `report.html`, `report.json`, and
//! `manifest.json`, written last, all create-only. A name belongs to one report.

use std::sync::Arc;

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};

use crate::error::DatasetError;
use crate::layout::manifest::{ObjectEntry, read_sealed, sha256_hex};
use crate::store::many::check_size;
use crate::store::objects;

/// The folder of reports in a store; no data set has this name.
pub const REPORTS: &str = "reports";
/// The object that makes a report one.
const MANIFEST: &str = "manifest.json";
/// Version of manifests of reports.
const FORMAT: u32 = 1;

/// The reports of a store.
#[derive(Debug, Clone)]
pub struct Reports {
    store: Arc<dyn ObjectStore>,
    folder: Path,
}

/// What a report is. A pure function of its task: no times, no machine.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReportManifest {
    /// Version of this form; filled in.
    pub format: u32,
    /// The report's name.
    pub name: String,
    /// Key of the task that made it: models, evaluations, settings and code.
    pub task_key: String,
    /// Version of networks and metrics.
    pub code: String,
    /// The models that it tells of, in its order.
    pub models: Vec<ReportedModel>,
    /// Its objects; keys below the report's folder. Filled in.
    pub objects: Vec<ObjectEntry>,
    /// What [`crate::layout::manifest::seal`] says of the rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

/// A model in a report.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReportedModel {
    /// Its name.
    pub name: String,
    /// SHA-256 of its manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Key of the evaluation whose figures are shown; `None` where it was not evaluated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<String>,
    /// SHA-256 of the record of the training's speed, hexadecimal; `None` where nothing is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<String>,
}

impl ReportManifest {
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

    fn parse(bytes: &[u8], object: &str) -> Result<Self, DatasetError> {
        read_sealed(bytes, "a report's manifest", FORMAT, object)
    }
}

impl Reports {
    /// The reports of the store at `prefix`.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: &Path) -> Self {
        Self {
            store,
            folder: prefix.clone().join(REPORTS),
        }
    }

    /// Where a report lies, for a message.
    pub fn place(&self, name: &str) -> String {
        objects::shown(&*self.store, &self.folder.clone().join(name))
    }

    /// The manifest of a report that this very task has published, after checking that each of its objects exists with the
    /// stated size; `None` where it is not published.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where the name is another report's; [`DatasetError::Damaged`] where an object is missing or
    /// has another size; [`DatasetError::Store`].
    pub async fn finished(
        &self,
        name: &str,
        task_key: &str,
    ) -> Result<Option<ReportManifest>, DatasetError> {
        let path = self.path(name, MANIFEST);
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        let manifest = ReportManifest::parse(&bytes, &objects::shown(&*self.store, &path))?;
        if manifest.task_key != task_key {
            let what = format!(
                "{} holds a report of other models, evaluations or settings (task key {}, this one's is {task_key}); choose \
                 another name, or delete that folder",
                self.place(name),
                manifest.task_key
            );
            return Err(DatasetError::invalid("report.name", what));
        }
        for object in &manifest.objects {
            check_size(&*self.store, self.path(name, &object.key), object.size).await?;
        }
        Ok(Some(manifest))
    }

    /// Publishes a report: `objects` first, the manifest last, whose format, objects and checksum are filled in.
    ///
    /// # Errors
    /// [`DatasetError::Conflict`] where an object exists with other bytes: another report of this name was made, or begun;
    /// [`DatasetError::Store`].
    pub async fn publish(
        &self,
        manifest: ReportManifest,
        objects: &[(&str, Bytes)],
    ) -> Result<ReportManifest, DatasetError> {
        let entry = |(file, bytes): &(&str, Bytes)| ObjectEntry {
            key: (*file).to_owned(),
            size: bytes.len() as u64,
            sha256: sha256_hex(bytes),
        };
        let mut manifest = ReportManifest {
            format: FORMAT,
            objects: objects.iter().map(entry).collect(),
            checksum: None,
            ..manifest
        };
        manifest.checksum = Some(manifest.sha256());
        for (file, bytes) in objects {
            let path = self.path(&manifest.name, file);
            objects::create_or_match(&*self.store, &path, bytes.clone()).await?;
        }
        let path = self.path(&manifest.name, MANIFEST);
        objects::create_or_match(&*self.store, &path, manifest.to_bytes().into()).await?;
        Ok(manifest)
    }

    fn path(&self, name: &str, key: &str) -> Path {
        objects::path_of(&self.folder.clone().join(name), key)
    }
}
