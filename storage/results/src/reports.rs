//! Reports about models: `reports/<name>/` in a store, next to its data sets and models. A report
//! consists of `report.html`, `report.json`, and `manifest.json`, which is written last, all
//! create-only. Each name belongs to one report.

use std::sync::Arc;

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};

use picofarm_store::published::{Manifest, Published};
use picofarm_store::sealed::{document, read_sealed};
use picofarm_store::{ObjectEntry, StorageError, VerifyMode};

/// The folder of reports in a store. No data set can have this name.
pub const REPORTS: &str = "reports";
/// Format version of report manifests.
const FORMAT: u32 = 1;

/// The reports of a store.
#[derive(Debug, Clone)]
pub struct Reports(Published<ReportManifest>);

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
    /// Checksum of the other fields, from `picofarm_store::sealed::seal`.
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

impl Manifest for ReportManifest {
    type Id = String;

    fn parse(bytes: &[u8], name: &String, object: &str) -> Result<Self, StorageError> {
        let manifest: Self = read_sealed(bytes, "a report's manifest", FORMAT, object)?;
        match manifest.name == *name {
            true => Ok(manifest),
            false => Err(StorageError::Damaged {
                object: object.to_owned(),
                what: format!("is that of the report {:?}", manifest.name),
            }),
        }
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
            "{place} holds a report of other models, evaluations or settings (task key {}, this one's is {task_key}); choose \
             another name, or delete that folder",
            self.task_key
        );
        StorageError::invalid("report.name", what)
    }
}

impl Reports {
    /// Returns the reports of the store at `prefix`.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: &Path) -> Self {
        Self(Published::new(store, prefix.clone().join(REPORTS)))
    }

    /// Returns a report's location for messages.
    pub fn place(&self, name: &str) -> String {
        self.0.location(&name.to_owned())
    }

    /// Returns the manifest of a report; `None` if there is none of this name.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn look(&self, name: &str) -> Result<Option<ReportManifest>, StorageError> {
        self.0.manifest(&name.to_owned()).await
    }

    /// Returns an object of a report, after checking its SHA-256.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if the manifest names no such file, or if the object is missing or
    /// changed; [`StorageError::Store`].
    pub async fn read(&self, manifest: &ReportManifest, file: &str) -> Result<Bytes, StorageError> {
        let Some(entry) = manifest.objects.iter().find(|object| object.key == file) else {
            return Err(StorageError::Damaged {
                object: self.place(&manifest.name),
                what: format!("names no object {file:?}"),
            });
        };
        self.0.read(&manifest.name, entry).await
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
        let name = name.to_owned();
        self.0.finished(&name, task_key, VerifyMode::Fast).await
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
        let entry = |(file, bytes): &(&str, Bytes)| ObjectEntry::new(*file, bytes);
        let mut manifest = ReportManifest {
            format: FORMAT,
            objects: objects.iter().map(entry).collect(),
            checksum: None,
            ..manifest
        };
        manifest.checksum = Some(manifest.sha256());
        let bytes: Vec<Bytes> = objects.iter().map(|(_, bytes)| bytes.clone()).collect();
        self.0.publish(&manifest.name, &manifest, &bytes).await?;
        Ok(manifest)
    }
}
