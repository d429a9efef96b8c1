//! Source of two-bounce times: the true depths, or those predicted by an infer stage.

use picofarm_dataset::{Dataset, Pinned};
use picofarm_proto::spec::train::TRUTH;
use picofarm_results::{DepthsUsed, PinnedDepths, Predictions};
use picofarm_store::StorageError;

use crate::{
    errors::{dataset_error, in_field},
    stores::Stores,
    task::{Control, TaskError},
};

/// Source of two-bounce times.
pub(crate) struct Times {
    /// `truth`, or a folder of the store.
    pub(crate) name: String,
    /// The predictions in that folder.
    pub(crate) predictions: Option<Predictions>,
}

impl Times {
    /// Opens the source with the given `name` in the store of a data set.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` if there are no such predictions, or they have another size.
    pub(crate) fn open(
        stores: &Stores,
        store: &str,
        dataset: &Dataset,
        (field, name): (&str, &str),
        control: &Control,
    ) -> Result<Self, TaskError> {
        if name == TRUTH {
            return Ok(Self {
                name: name.to_owned(),
                predictions: None,
            });
        }
        let (place, prefix) = stores.source(store, control)?;
        let opened = stores.wait(control, Predictions::open(place, prefix.join(name)));
        let predictions = opened.map_err(|e| in_field(field, e))?;
        let (theirs, ours) = (predictions.spec(), dataset.spec());
        if (theirs.height, theirs.width) != (ours.height, ours.width) {
            return Err(TaskError::User(format!(
                "{field}: {} has images of {}x{} pixels, the data set of {}x{}; name predictions of this data set",
                predictions.place(),
                theirs.width,
                theirs.height,
                ours.width,
                ours.height
            )));
        }
        Ok(Self {
            name: name.to_owned(),
            predictions: Some(predictions),
        })
    }

    /// Returns whether the times are derived from the true depths.
    pub(crate) fn are_true(&self) -> bool {
        self.predictions.is_none()
    }

    /// Returns the hashes of the scenes' depths; `None` for the true depths, which the scenes'
    /// hashes cover.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` if depths are missing, belong to other scenes, or come from
    /// several models.
    pub(crate) fn pin(
        &self,
        stores: &Stores,
        field: &str,
        scenes: &[u64],
        pinned: &Pinned,
        control: &Control,
    ) -> Result<Option<PinnedDepths>, TaskError> {
        let Some(predictions) = &self.predictions else {
            return Ok(None);
        };
        let asked = predictions.pin_depths(scenes, &pinned.manifests);
        let found = stores.wait_for(control, asked, |error| match error {
            StorageError::Invalid { what, .. } => TaskError::User(format!("{field}: {what}")),
            StorageError::NotPublished { scene, .. } => TaskError::User(format!(
                "{field}: {} holds nothing of scene {scene}; let its infer stage predict every scene of the data set",
                predictions.place()
            )),
            error => in_field(field, dataset_error(error)),
        });
        found.map(Some)
    }

    /// Returns the entry for a model's lineage.
    pub(crate) fn used(&self, pinned: Option<&PinnedDepths>) -> Option<DepthsUsed> {
        pinned.map(|pinned| DepthsUsed {
            predictions: self.name.clone(),
            id: pinned.id.clone(),
        })
    }
}
