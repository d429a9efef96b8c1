//! Removes a model: writes a note of the objects to delete, then deletes the manifest, the objects
//! and the note. An interrupted removal can be continued from the note. Only objects in the note
//! are deleted, and none that a manifest lists.

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use serde::{Deserialize, Serialize};

use super::{MANIFEST, MODELS, ModelManifest, Models, check_name, speed};
use crate::predictions::{ModelUsed, PredictionManifest, Predictions, TimesUsed};
use crate::reports::REPORTS;
use picofarm_store::StorageError;
use picofarm_store::objects;

/// Name of the object with the note.
pub(super) const REMOVING: &str = "removing.json";
/// Number of manifests read concurrently.
const AT_ONCE: usize = 16;

/// The objects to delete.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Note {
    /// SHA-256 of the manifest; empty if it could not be read.
    manifest_sha256: String,
    training_key: String,
    /// Keys relative to the model.
    objects: Vec<String>,
}

/// Objects that depend on a model.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Dependents {
    /// Models trained with it.
    pub models: Vec<String>,
    /// Groups of predictions made with it, or using two-bounce times computed from it.
    pub predictions: Vec<String>,
}

impl Dependents {
    /// Returns whether nothing depends on the model.
    pub fn is_empty(&self) -> bool {
        self.models.is_empty() && self.predictions.is_empty()
    }
}

/// The result of removing a model.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Removed {
    /// Deleted objects, in order of deletion.
    pub deleted: Vec<String>,
    /// Objects that remain under the name: of other trainings, of sweeps, and unknown ones.
    pub left: Vec<String>,
}

impl Models {
    /// Returns the dependents of a model. An unreadable manifest may depend on any model.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for an invalid name; [`StorageError::Store`].
    pub async fn dependents(&self, name: &str) -> Result<Dependents, StorageError> {
        check_name(name)?;
        let sha256 = match self.look(name).await {
            Ok(manifest) => manifest.map(|m| m.sha256()),
            Err(StorageError::Damaged { .. }) => None,
            Err(error) => return Err(error),
        };
        let is =
            |other: &str, hash: &str| other == name && sha256.as_deref().is_none_or(|s| s == hash);
        let mut found = Dependents::default();
        for other in self.names().await? {
            if other == name {
                continue;
            }
            match self.look(&other).await {
                Ok(None) => {}
                Ok(Some(manifest)) => {
                    if manifest.lineage.models.iter().any(|(n, hash)| is(n, hash)) {
                        found.models.push(other);
                    }
                }
                Err(StorageError::Damaged { .. }) => {
                    found
                        .models
                        .push(format!("{other} (its manifest cannot be read)"));
                }
                Err(error) => return Err(error),
            }
        }
        let parts: Vec<_> = self.folder.parts().collect();
        let root: object_store::path::Path = parts[..parts.len() - 1]
            .iter()
            .map(|p| p.as_ref().to_owned())
            .collect();
        let listed = self.store.list_with_delimiter(Some(&root)).await;
        let listed = listed.map_err(|e| self.failed("list", &root, e))?;
        for group in listed.common_prefixes {
            if [MODELS, REPORTS].map(Some).contains(&group.filename()) {
                continue;
            }
            let Some(there) = Predictions::find(self.store.clone(), group.clone()).await? else {
                continue;
            };
            let scenes = there.scenes_present().await?;
            let looks = scenes.iter().map(|scene| there.manifest(*scene));
            let mut looks = stream::iter(looks.collect::<Vec<_>>()).buffer_unordered(AT_ONCE);
            while let Some(looked) = looks.next().await {
                let builds = match looked {
                    Ok(manifest) => used(&manifest).any(|m| is(&m.name, &m.manifest_sha256)),
                    Err(StorageError::Damaged { .. } | StorageError::NotPublished { .. }) => false,
                    Err(error) => return Err(error),
                };
                if builds {
                    found.predictions.push(there.place());
                    break;
                }
            }
        }
        Ok(found)
    }

    /// Removes a model: its manifest first, then its objects, evaluations, checkpoints and speed.
    /// An interrupted removal is continued. Dependents are not checked: see [`Self::dependents`].
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there is no such model, or if it is still in training (no
    /// manifest, and no removal in progress) and `unfinished` is not set; [`StorageError::Store`].
    pub async fn remove(&self, name: &str, unfinished: bool) -> Result<Removed, StorageError> {
        check_name(name)?;
        let note_path = self.path(name, REMOVING);
        let mut removed = Removed::default();
        let note = match objects::get(&*self.store, &note_path).await? {
            Some(bytes) => self.note_of(&bytes),
            None => None,
        };
        let note = match note {
            Some(note) => note,
            None => {
                let note = self.note(name, unfinished).await?;
                let bytes = serde_json::to_vec_pretty(&note).expect("plain data");
                objects::overwrite(&*self.store, &note_path, Bytes::from(bytes)).await?;
                note
            }
        };
        let manifest_path = self.path(name, MANIFEST);
        if let Some(bytes) = objects::get(&*self.store, &manifest_path).await? {
            let hash = picofarm_store::sealed::sha256_hex(&bytes);
            if hash == note.manifest_sha256 {
                self.remove_one(&manifest_path, &mut removed).await?;
            }
        }
        for key in &note.objects {
            let path = self.path(name, key);
            let there = objects::size(&*self.store, &path).await?.is_some();
            if there
                && !self.named(name, key).await?
                && self.delete_object(name, key, &path).await?
            {
                removed.deleted.push(self.shown(&path));
            }
        }
        self.remove_records(name, &note, &mut removed).await?;
        self.delete(&note_path).await?;
        let left = self.list(&self.folder.clone().join(name)).await?;
        removed.left = left.iter().map(|o| self.shown(&o.location)).collect();
        removed.left.sort();
        Ok(removed)
    }

    /// Returns the note of a new removal.
    async fn note(&self, name: &str, unfinished: bool) -> Result<Note, StorageError> {
        let folder = self.folder.clone().join(name);
        let there = self.list(&folder).await?;
        let keys = there
            .iter()
            .filter_map(|o| super::key_below(&folder, &o.location));
        let keys: Vec<String> = keys
            .filter(|key| super::object_folder(key).is_some())
            .collect();
        let looked = match self.look(name).await {
            Err(StorageError::Damaged { .. }) if unfinished => Err(()),
            found => Ok(found?),
        };
        match looked {
            Ok(Some(manifest)) => Ok(Note {
                manifest_sha256: manifest.sha256(),
                training_key: manifest.training_key.clone(),
                objects: manifest.objects.into_iter().map(|o| o.key).collect(),
            }),
            Err(()) => {
                // The objects of an unreadable manifest are unknown, so everything under the name
                // is deleted.
                let bytes = objects::require(&*self.store, &self.path(name, MANIFEST)).await?;
                Ok(Note {
                    manifest_sha256: picofarm_store::sealed::sha256_hex(&bytes),
                    training_key: String::new(),
                    objects: keys,
                })
            }
            Ok(None) if unfinished && !there.is_empty() => Ok(Note {
                manifest_sha256: String::new(),
                training_key: String::new(),
                objects: keys,
            }),
            Ok(None) => {
                // Returns an error that lists the existing models, and states whether this one is
                // still in training.
                self.manifest(name).await?;
                Err(StorageError::invalid(
                    "model",
                    format!("{name:?} appeared just now; try again"),
                ))
            }
        }
    }

    fn note_of(&self, bytes: &[u8]) -> Option<Note> {
        // A torn note is written again, because nothing is deleted before the note is complete.
        serde_json::from_slice(bytes).ok()
    }

    /// Returns whether the current manifest lists an object, because the same training was run
    /// again in the meantime.
    async fn named(&self, name: &str, key: &str) -> Result<bool, StorageError> {
        match self.look(name).await {
            Ok(manifest) => Ok(manifest.is_some_and(|m| m.objects.iter().any(|o| o.key == key))),
            Err(StorageError::Damaged { .. }) => Ok(true),
            Err(error) => Err(error),
        }
    }

    /// Deletes the evaluations, checkpoints and speed of the removed model.
    async fn remove_records(
        &self,
        name: &str,
        note: &Note,
        removed: &mut Removed,
    ) -> Result<(), StorageError> {
        let all = note.training_key.is_empty();
        // If the same training was run again, it has the same evaluations and speed.
        if self
            .look(name)
            .await
            .is_ok_and(|m: Option<ModelManifest>| m.is_some())
        {
            return Ok(());
        }
        for object in self.list(&self.path(name, "evaluations")).await? {
            let key = object
                .location
                .filename()
                .and_then(|f| f.strip_suffix(".json"));
            let of_it = match self.evaluation(name, key.unwrap_or_default()).await {
                Ok(found) => found.is_none_or(|e| e.model_sha256 == note.manifest_sha256),
                Err(StorageError::Damaged { .. }) => true,
                Err(error) => return Err(error),
            };
            if all || of_it {
                self.remove_one(&object.location, removed).await?;
            }
        }
        for folder in [super::shard::FOLDER, super::call::FOLDER] {
            for object in self.list(&self.path(name, folder)).await? {
                self.remove_one(&object.location, removed).await?;
            }
        }
        for checkpoint in self.checkpoints(name).await? {
            if all || checkpoint.training_key == note.training_key {
                for object in &checkpoint.objects {
                    self.remove_one(&object.location, removed).await?;
                }
            }
        }
        let path = self.path(name, speed::FILE);
        if objects::size(&*self.store, &path).await?.is_some() {
            self.remove_one(&path, removed).await?;
        }
        Ok(())
    }

    async fn remove_one(
        &self,
        path: &object_store::path::Path,
        removed: &mut Removed,
    ) -> Result<(), StorageError> {
        self.delete(path).await?;
        removed.deleted.push(self.shown(path));
        Ok(())
    }

    /// Returns the reports that mention a model. They are not changed by its removal.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn reports_of(&self, name: &str) -> Result<Vec<String>, StorageError> {
        let parts: Vec<_> = self.folder.parts().collect();
        let root: object_store::path::Path = parts[..parts.len() - 1]
            .iter()
            .map(|p| p.as_ref().to_owned())
            .chain([REPORTS.to_owned()])
            .collect();
        let objects: Vec<_> = self
            .store
            .list(Some(&root))
            .try_collect()
            .await
            .map_err(|e| self.failed("list", &root, e))?;
        let mut found = Vec::new();
        for object in objects
            .iter()
            .filter(|o: &&object_store::ObjectMeta| o.location.filename() == Some(MANIFEST))
        {
            let bytes = objects::get(&*self.store, &object.location)
                .await?
                .unwrap_or_default();
            let report: Option<crate::reports::ReportManifest> =
                serde_json::from_slice(&bytes).ok();
            if let Some(report) = report.filter(|r| r.models.iter().any(|m| m.name == name)) {
                found.push(report.name);
            }
        }
        found.sort();
        Ok(found)
    }
}

/// Returns the models used for predictions.
fn used(manifest: &PredictionManifest) -> impl Iterator<Item = &ModelUsed> {
    let times = match &manifest.two_bounce_times {
        Some(TimesUsed::Model(model)) => Some(model),
        _ => None,
    };
    manifest.models.values().chain(times)
}
