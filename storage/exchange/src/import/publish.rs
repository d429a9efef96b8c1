//! Publishes imported scenes in a data set with their provenance, and finds them again when an
//! import is resumed.

use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::{IMPORT_VERSION, ImportError, ImportedScene, Source, SourceFile};
use picofarm_dataset::Dataset;
use picofarm_dataset::EncodedScene;
use picofarm_dataset::Provenance;
use picofarm_dataset::whole_photons;
use picofarm_dataset::{ENCODER_VERSION, Manifest};
use picofarm_store::StorageError;

/// What the values of an imported measurement are, as manifests state it.
const COUNTS: &str = "counts: photons counted in the bin, as imported";

impl Source {
    /// Encodes an imported scene as scene `at` of the data set; publish it with
    /// [`Dataset::publish_encoded`]. It blocks while rayon threads encode.
    ///
    /// # Errors
    /// [`ImportError::Dataset`].
    pub fn encode(
        &self,
        dataset: &Dataset,
        at: u64,
        scene: &ImportedScene,
    ) -> Result<EncodedScene, ImportError> {
        let key = json!({
            "import": IMPORT_VERSION, "encoder": ENCODER_VERSION, "format": self.format, "options": self.options,
            "profile": dataset.spec().profile, "scene": scene.name, "files": scene.files,
        });
        let mut plan = json!({
            "kind": "import", "format": self.format, "options": self.options, "scene": scene.name,
            "files": scene.files, "conversions": scene.conversions, "missing": scene.missing, "check": scene.check,
        });
        // The code of the data set may round counts, so that they no longer show what they are.
        if scene.with_record(|record| whole_photons(record.transient, record.scale)) {
            plan["value"] = json!(COUNTS);
        }
        let provenance = Provenance {
            task_key: hex::encode(Sha256::digest(key.to_string())),
            renderer: format!("{IMPORT_VERSION}/{ENCODER_VERSION}"),
            seed: 0,
            plan,
        };
        let encoded = scene.with_record(|record| dataset.encode(at, record, &provenance));
        Ok(encoded?)
    }

    /// Returns the manifest of scene `at` of the data set if this import has already published its
    /// scene `index` there: from the same files by name and size, with the same options. With
    /// `rehash`, the files' contents are also compared.
    ///
    /// # Errors
    /// [`ImportError::Refused`] if the data set contains another scene at this index;
    /// [`ImportError::Dataset`] if a published scene is damaged.
    pub async fn finished(
        &self,
        dataset: &Dataset,
        at: u64,
        index: u64,
        rehash: bool,
    ) -> Result<Option<Manifest>, ImportError> {
        let manifest = match dataset.published(at).await {
            Ok(Some(manifest)) => manifest,
            Ok(None) => return Ok(None),
            // Importing it again restores missing objects, or reports the problem.
            Err(StorageError::Damaged { .. }) => return Ok(None),
            Err(error) => return Err(error.into()),
        };
        let plan = &manifest.provenance.plan;
        let ours = [
            ("kind", json!("import")),
            ("scene", json!(self.name(index))),
            ("format", json!(self.format)),
            ("options", json!(self.options)),
        ];
        for (field, expected) in ours {
            if plan[field] != expected {
                return Err(self.other(dataset, at, field, &expected, &plan[field]));
            }
        }
        let version = json!(format!("{IMPORT_VERSION}/{ENCODER_VERSION}"));
        let stored = json!(manifest.provenance.renderer);
        if stored != version {
            return Err(self.other(dataset, at, "version", &version, &stored));
        }
        let files: Vec<SourceFile> =
            serde_json::from_value(plan["files"].clone()).map_err(|e| {
                self.other(
                    dataset,
                    at,
                    "files",
                    &json!("a list"),
                    &json!(e.to_string()),
                )
            })?;
        for file in &files {
            self.unchanged(dataset, at, file, rehash)?;
        }
        Ok(Some(manifest))
    }

    fn unchanged(
        &self,
        dataset: &Dataset,
        index: u64,
        file: &SourceFile,
        rehash: bool,
    ) -> Result<(), ImportError> {
        let files = super::Files::new(&self.root, &self.opener);
        let path = files.named(&self.root, &file.name)?;
        let now = files.open(&path)?.metadata();
        let now = now.map_err(|e| ImportError::io("look up", &path, e))?;
        if now.len() != file.bytes {
            let (now, then) = (json!(now.len()), json!(file.bytes));
            return Err(self.other(
                dataset,
                index,
                &format!("size of {}", file.name),
                &now,
                &then,
            ));
        }
        if rehash {
            files.hash(&path)?;
            let now = files.into_list().remove(0).sha256;
            if now != file.sha256 {
                let what = format!("SHA-256 of {}", file.name);
                return Err(self.other(dataset, index, &what, &json!(now), &json!(file.sha256)));
            }
        }
        Ok(())
    }

    fn other(
        &self,
        dataset: &Dataset,
        index: u64,
        field: &str,
        expected: &Value,
        found: &Value,
    ) -> ImportError {
        ImportError::refused(
            dataset.shown(&dataset.path(&Manifest::key(index))),
            field,
            format!("{expected}, as this import has it"),
            found.to_string(),
            "import into another data set; if scenes were added to the source, keep their order with --list",
        )
    }
}
