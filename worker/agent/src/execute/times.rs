//! What two-bounce times follow from: the truth's depths, or those that an infer stage has kept.

use picofarm_dataset::{Dataset, DatasetError, DepthsUsed, Pinned, PinnedDepths, Predictions};
use picofarm_proto::model::train::TRUTH;

use super::{
    Control, TaskError,
    output::{Stores, of_dataset},
    train::at,
};

/// What two-bounce times follow from.
pub(super) struct Times {
    /// `truth`, or a folder of the store.
    pub(super) name: String,
    /// The predictions in that folder.
    pub(super) predictions: Option<Predictions>,
}

impl Times {
    /// Those that `name` stands for, in the store of a data set.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` where there are none, or they are of another size.
    pub(super) fn of(
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
        let predictions = opened.map_err(|e| at(field, e))?;
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

    /// Whether they follow from the truth.
    pub(super) fn are_true(&self) -> bool {
        self.predictions.is_none()
    }

    /// What pins the depths of scenes; `None` where they are the truth's, which the scenes pin.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` where depths are missing, are of other scenes or by several models.
    pub(super) fn pin(
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
            DatasetError::Invalid { what, .. } => TaskError::User(format!("{field}: {what}")),
            DatasetError::NotPublished { scene, .. } => TaskError::User(format!(
                "{field}: {} holds nothing of scene {scene}; let its infer stage predict every scene of the data set",
                predictions.place()
            )),
            error => at(field, of_dataset(error)),
        });
        found.map(Some)
    }

    /// What a model's lineage says of them.
    pub(super) fn used(&self, pinned: Option<&PinnedDepths>) -> Option<DepthsUsed> {
        pinned.map(|pinned| DepthsUsed {
            predictions: self.name.clone(),
            id: pinned.id.clone(),
        })
    }
}
