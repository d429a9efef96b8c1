//! Reports about models: `reports/<name>/` in a store, next to its data sets and models. A report
//! consists of `report.html`, `report.json`, and `manifest.json`, which is written last, all
//! create-only. Each name belongs to one report.

use std::sync::Arc;

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};

use picofarm_store::StorageError;
use picofarm_store::many::check_size;
use picofarm_store::objects;
use picofarm_store::sealed::{ObjectEntry, read_sealed, sha256_hex};

/// The folder of reports in a store. No data set can have this name.
pub const REPORTS: &str = "reports";
/// Name of the manifest, which marks a report as published.
const MANIFEST: &str = "manifest.json";
/// Format version of report manifests.
const FORMAT: u32 = 1;

/// The reports of a store.
#[derive(Debug, Clone)]
pub struct Reports {
    store: Arc<dyn ObjectStore>,
    folder: Path,
}

/// The contents of a report. It is a pure function of its task, without times or machine names.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReportManifest {
    /// Format version of the manifest. Set on publishing.
    pub format: u32,
    /// The report's name.
    pub name: String,
    /// Key of the task that produced it: models, evaluations, settings and code.
    pub task_key: String,
    /// Code version of networks and metrics.
    pub code: String,
    /// The reported models, in order.
    pub models: Vec<ReportedModel>,
    /// Its objects, with keys relative to the report's folder. Set on publishing.
    pub objects: Vec<ObjectEntry>,
    /// Checksum of the other fields, from `layout::manifest::seal`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

/// A model in a report.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReportedModel {
    /// Name of the model.
    pub name: String,
    /// SHA-256 of the model's manifest, in hexadecimal.
    pub manifest_sha256: String,
    /// Key of the reported evaluation; `None` if the model was not evaluated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<String>,
    /// SHA-256 of the record of the training's speed, in hexadecimal; `None` if there is no record.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<String>,
}

impl ReportManifest {
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

    fn parse(bytes: &[u8], object: &str) -> Result<Self, StorageError> {
        read_sealed(bytes, "a report's manifest", FORMAT, object)
    }
}

impl Reports {
    /// Returns the reports of the store at `prefix`.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: &Path) -> Self {
        Self {
            store,
            folder: prefix.clone().join(REPORTS),
        }
    }

    /// Returns a report's location for messages.
    pub fn place(&self, name: &str) -> String {
        objects::shown(&*self.store, &self.folder.clone().join(name))
    }

    /// Returns the manifest of a report that this task has published, after checking the size of
    /// each object. Returns `None` if the report is not published.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the name belongs to another report; [`StorageError::Damaged`]
    /// if an object is missing or has another size; [`StorageError::Store`].
    pub async fn finished(
        &self,
        name: &str,
        task_key: &str,
    ) -> Result<Option<ReportManifest>, StorageError> {
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
            return Err(StorageError::invalid("report.name", what));
        }
        for object in &manifest.objects {
            check_size(&*self.store, self.path(name, &object.key), object.size).await?;
        }
        Ok(Some(manifest))
    }

    /// Publishes a report: `objects` first, the manifest last. The manifest's format, objects and
    /// checksum are set here.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object exists with different bytes, because another report
    /// of this name was published or begun; [`StorageError::Store`].
    pub async fn publish(
        &self,
        manifest: ReportManifest,
        objects: &[(&str, Bytes)],
    ) -> Result<ReportManifest, StorageError> {
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
