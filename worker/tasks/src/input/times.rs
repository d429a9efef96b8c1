//! Source of two-bounce times: the true depths, or those predicted by a stage. A network of variant
//! `evidence` takes the evidence of a demultiplex stage instead.

use picofarm_dataset::{Dataset, Pinned};
use picofarm_model::input::{EvidenceForm, Question};
use picofarm_proto::spec::train::TRUTH;
use picofarm_results::{DepthsUsed, PinnedDepths, Predictions};
use picofarm_store::StorageError;

use crate::{
    errors::{dataset_error, in_field},
    stores::Stores,
    task::{Control, TaskError},
};

/// What a network takes.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Taken<'a> {
    /// Two-bounce times.
    Times,
    /// Evidence: of this form if the network exists, or else of any.
    Evidence(Option<&'a EvidenceForm>),
}

impl<'a> Taken<'a> {
    /// Returns what a trained network takes; `None` if it takes neither.
    pub(crate) fn by(question: &'a Question) -> Option<Self> {
        match question.sees_evidence() {
            true => Some(Self::Evidence(question.evidence.as_ref())),
            false => question.timed().then_some(Self::Times),
        }
    }
}

/// Source of two-bounce times or of evidence.
pub(crate) struct Times {
    /// `truth`, or a folder of the store.
    pub(crate) name: String,
    /// The predictions in that folder.
    pub(crate) predictions: Option<Predictions>,
    /// Whether the evidence of the predictions is taken, and not their depths.
    evidence: bool,
}

impl Times {
    /// Opens the source with the given `name` in the store of a data set.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` if there are no such predictions, or they have another size
    /// or other evidence than the network takes.
    pub(crate) fn open(
        stores: &Stores,
        store: &str,
        dataset: &Dataset,
        (field, name): (&str, &str),
        taken: Taken<'_>,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let evidence = matches!(taken, Taken::Evidence(_));
        if name == TRUTH && evidence {
            return Err(TaskError::User(format!(
                "{field}: is \"truth\", but the network takes the evidence of a demultiplex stage; name one with \
                 demultiplex.evidence = true"
            )));
        }
        if name == TRUTH {
            return Ok(Self {
                name: name.to_owned(),
                predictions: None,
                evidence,
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
        if let Taken::Evidence(wanted) = taken {
            check_evidence(field, &predictions, wanted)?;
        }
        Ok(Self {
            name: name.to_owned(),
            predictions: Some(predictions),
            evidence,
        })
    }

    /// Returns whether the times are derived from the true depths.
    pub(crate) fn are_true(&self) -> bool {
        self.predictions.is_none()
    }

    /// Returns the predictions whose depths give two-bounce times, if any.
    pub(crate) fn depths(&self) -> Option<Predictions> {
        self.predictions.clone().filter(|_| !self.evidence)
    }

    /// Returns the predictions whose evidence the network sees, if any.
    pub(crate) fn evidence(&self) -> Option<Predictions> {
        self.predictions.clone().filter(|_| self.evidence)
    }

    /// Returns the hashes of the scenes' depths or evidence; `None` for the true depths, which the
    /// scenes' hashes cover.
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
        let asked = async {
            match self.evidence {
                true => predictions.pin_evidence(scenes, &pinned.manifests).await,
                false => predictions.pin_depths(scenes, &pinned.manifests).await,
            }
        };
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

/// Refuses predictions without evidence, and evidence that a network was not trained on.
fn check_evidence(
    field: &str,
    predictions: &Predictions,
    wanted: Option<&EvidenceForm>,
) -> Result<(), TaskError> {
    let place = predictions.place();
    let Some(there) = &predictions.spec().evidence else {
        return Err(TaskError::User(format!(
            "{field}: {place} holds no evidence; name a demultiplex stage with demultiplex.evidence = true"
        )));
    };
    let Some(wanted) = wanted.filter(|wanted| *wanted != there) else {
        return Ok(());
    };
    let shown = |form: &EvidenceForm| format!("{} planes of {:?}", form.planes.len(), form.version);
    Err(TaskError::User(format!(
        "{field}: {place} has {}, but the network was trained on {}; take the flashes apart again with the version that \
         the network was trained on, or train it again",
        shown(there),
        shown(wanted)
    )))
}
