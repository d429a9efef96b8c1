//! Checks everything other than scenes: metadata, snapshots, recipes and splits.

use serde_json::Value;

use super::{Fault, Problem, Verification};
use crate::layout::group::METADATA;
use crate::repair::listing::Listing;
use crate::repair::recipe;
use crate::scenes::dataset::Dataset;
use crate::scenes::snapshot::Snapshot;
use crate::scenes::{snapshot, splits};
use picofarm_store::objects;
use picofarm_store::{RecordKind, StorageError};

impl Dataset {
    /// Checks that the metadata is as the specification requires.
    pub(super) async fn verify_metadata(
        &self,
        report: &mut Verification,
    ) -> Result<(), StorageError> {
        for (key, expected) in self.metadata() {
            let path = self.path(&key);
            let fault = match objects::get(&*self.store, &path).await? {
                None => Some(Fault::Missing),
                Some(bytes) => metadata_fault(&bytes, &expected),
            };
            report.problems.extend(fault.map(|fault| Problem {
                object: self.shown(&path),
                scene: None,
                fault,
            }));
        }
        Ok(())
    }

    /// Returns keys and contents of the metadata that the specification requires, the root's first.
    pub(crate) fn metadata(&self) -> Vec<(String, Value)> {
        let root = crate::scenes::dataset::root_metadata(&self.spec);
        let arrays = self.arrays.iter().map(|array| {
            let key = format!("{}/{METADATA}", array.layout.quantity.name());
            (key, array.layout.metadata(self.spec.scenes))
        });
        std::iter::once((METADATA.to_string(), root))
            .chain(arrays)
            .collect()
    }

    /// Checks that snapshots, recipes and splits are unchanged.
    pub(super) async fn verify_records(
        &self,
        listing: &Listing,
        report: &mut Verification,
    ) -> Result<(), StorageError> {
        for key in &listing.records {
            let path = self.path(key);
            let Some(bytes) = objects::get(&*self.store, &path).await? else {
                continue;
            };
            let checked = match snapshot::is_snapshot(key) {
                true => Snapshot::parse(&bytes).map(drop),
                false if splits::is_split(key) => splits::check(key, &bytes).map(drop),
                false => recipe::parse(&bytes).map(drop),
            };
            report.problems.extend(checked.err().map(|why| Problem {
                object: self.shown(&path),
                scene: None,
                fault: Fault::BadRecord {
                    kind: RecordKind::Dataset,
                    why,
                },
            }));
        }
        Ok(())
    }
}

/// Compares stored metadata with the expected ones. Returns their fault, if they differ.
pub fn metadata_fault(bytes: &[u8], expected: &Value) -> Option<Fault> {
    let stored: Value = match serde_json::from_slice(bytes) {
        Ok(stored) => stored,
        Err(e) => return Some(Fault::BadMetadata(format!("not JSON: {e}"))),
    };
    let member = |value: &Value| value.as_object().cloned().unwrap_or_default();
    let (stored, expected) = (member(&stored), member(expected));
    let differing: Vec<&str> = expected
        .iter()
        .filter(|(key, value)| stored.get(*key) != Some(*value))
        .map(|(key, _)| key.as_str())
        .chain(
            stored
                .keys()
                .filter(|key| !expected.contains_key(*key))
                .map(String::as_str),
        )
        .collect();
    (!differing.is_empty()).then(|| {
        Fault::BadMetadata(format!(
            "not what the data set's specification gives: {}",
            differing.join(", ")
        ))
    })
}
