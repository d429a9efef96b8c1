//! Checks a model: manifest, each object's size and SHA-256, evaluations, checkpoints, and records
//! of trials.

use std::collections::BTreeSet;

use object_store::ObjectMeta;
use object_store::path::Path;

use super::{
    Evaluation, MANIFEST, ModelManifest, Models, Rung, TrainingSpeed, TrialRecord, check_name,
    key_below, object_folder, remove::REMOVING,
};
use crate::checkpoints;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::sha256_hex;
use picofarm_store::{Fault, Problem};

/// The result of checking a model.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ModelCheck {
    /// Its manifest, if it is readable. A model still in training has none.
    pub manifest: Option<ModelManifest>,
    /// Number of the manifest's objects checked.
    pub objects: u64,
    /// Their total size in bytes.
    pub bytes: u64,
    /// Number of evaluations checked.
    pub evaluations: u64,
    /// Number of checkpoints checked.
    pub checkpoints: u64,
    /// The problems, ordered by key.
    pub problems: Vec<Problem>,
    /// Objects that the manifest does not list, left by a killed training; `dataset gc` deletes
    /// them.
    pub unused: Vec<String>,
    /// Whether a removal of the model was begun but not finished.
    pub removing: bool,
}

impl ModelCheck {
    /// Returns whether there are no problems.
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty() && !self.removing
    }
}

impl Models {
    /// Checks everything under a model's name.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there is nothing; [`StorageError::Store`].
    pub async fn verify(&self, name: &str) -> Result<ModelCheck, StorageError> {
        check_name(name)?;
        let folder = self.folder.clone().join(name);
        let there = self.list(&folder).await?;
        if there.is_empty() {
            // Returns an error that lists the existing models.
            self.manifest(name).await?;
        }
        let mut check = ModelCheck::default();
        match self.look(name).await {
            Ok(manifest) => check.manifest = manifest,
            Err(StorageError::Damaged { object, what }) => check.problems.push(Problem {
                object,
                scene: None,
                fault: Fault::BadManifest(what),
            }),
            Err(error) => return Err(error),
        }
        let manifest = check.manifest.clone();
        for object in manifest.iter().flat_map(|m| &m.objects) {
            let path = self.path(name, &object.key);
            check.objects += 1;
            check.bytes += object.size;
            let fault = match objects::get(&*self.store, &path).await? {
                None => Fault::Missing,
                Some(bytes) if bytes.len() as u64 != object.size => Fault::WrongSize {
                    expected: object.size,
                    found: bytes.len() as u64,
                },
                Some(bytes) => match sha256_hex(&bytes) {
                    found if found == object.sha256 => continue,
                    found => Fault::WrongHash {
                        expected: object.sha256.clone(),
                        found,
                    },
                },
            };
            check.problems.push(Problem {
                object: self.shown(&path),
                scene: None,
                fault,
            });
        }
        let all: BTreeSet<Path> = there.iter().map(|object| object.location.clone()).collect();
        for object in &there {
            if let Some(key) = key_below(&folder, &object.location) {
                self.check_other(name, &key, (object, &all), &mut check)
                    .await?;
            }
        }
        check.problems.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(check)
    }

    /// Checks the objects that no manifest lists.
    async fn check_other(
        &self,
        name: &str,
        key: &str,
        (object, all): (&ObjectMeta, &BTreeSet<Path>),
        check: &mut ModelCheck,
    ) -> Result<(), StorageError> {
        let at = self.shown(&object.location);
        let bad = |what: &str| Some(Fault::BadRecord(what.to_owned()));
        let fault = match key.split_once('/') {
            None if key == MANIFEST => None,
            None if key == REMOVING => {
                check.removing = true;
                None
            }
            None if key == super::speed::FILE => {
                let bytes = objects::require(&*self.store, &object.location).await?;
                match serde_json::from_slice::<TrainingSpeed>(&bytes) {
                    Ok(_) => None,
                    Err(e) => bad(&format!("does not say how fast a training was: {e}")),
                }
            }
            Some(("evaluations", file)) => {
                check.evaluations += 1;
                let evaluation = file.strip_suffix(".json").unwrap_or(file);
                match self.evaluation(name, evaluation).await {
                    Ok(found) => found.and_then(|found| misplaced(&found, name, evaluation)),
                    Err(StorageError::Damaged { what, .. }) => bad(&what),
                    Err(error) => return Err(error),
                }
            }
            Some((checkpoints::FOLDER, _)) => match checkpoints::place(object) {
                None => Some(Fault::Foreign),
                Some((key, step, true)) => {
                    check.checkpoints += 1;
                    match self.checkpoints_of(name, &key)?.read(step).await? {
                        Some(_) => None,
                        None => bad("its content has not the checkpoint's checksums"),
                    }
                }
                // A piece is checked together with its head; without a head, it is a leftover.
                Some((key, step, false)) => {
                    let head = self.checkpoints_of(name, &key)?.head(step);
                    if !all.contains(&head) {
                        check.unused.push(at.clone());
                    }
                    None
                }
            },
            // It belongs to an unfinished or abandoned evaluation or training. A reader of a
            // damaged one regenerates it.
            Some((super::shard::FOLDER | super::call::FOLDER, _)) => {
                check.unused.push(at.clone());
                None
            }
            Some(("sweeps", _)) => {
                let bytes = objects::require(&*self.store, &object.location).await?;
                let said = match key.contains("/trials/") {
                    true => serde_json::from_slice::<TrialRecord>(&bytes).map(drop),
                    false => serde_json::from_slice::<Rung>(&bytes).map(drop),
                };
                said.err()
                    .and_then(|e| bad(&format!("is not what a trial says of itself: {e}")))
            }
            Some(_) if object_folder(key).is_some() => {
                let manifest = check.manifest.as_ref();
                if !manifest.is_some_and(|m| m.objects.iter().any(|o| o.key == key)) {
                    check.unused.push(at.clone());
                }
                None
            }
            _ => Some(Fault::Foreign),
        };
        check.problems.extend(fault.map(|fault| Problem {
            object: at,
            scene: None,
            fault,
        }));
        Ok(())
    }
}

/// Returns a fault if an evaluation is stored under the name or key of another.
fn misplaced(found: &Evaluation, name: &str, key: &str) -> Option<Fault> {
    let here = found.key == key && found.model == name;
    (!here).then(|| Fault::BadRecord(format!("is that of {:?}, key {}", found.model, found.key)))
}
