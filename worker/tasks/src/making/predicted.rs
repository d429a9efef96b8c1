//! Adopts and publishes the predictions of a scene, whether by networks or by physics.

pub(crate) mod agreement;

use picofarm_results::{EncodedPredictions, PredictionManifest, Predictions, Verdict};
use picofarm_store::StorageError;
use picofarm_store::published::Manifest as _;
use tracing::{info, warn};

use crate::{
    stores::{Stores, saying},
    task::{Control, Output, TaskError},
};

/// Logs whether the predictions of a scene agree.
fn tell(manifest: &PredictionManifest) {
    if let Some(verdict) = Verdict::of_agreement(&manifest.agreement) {
        saying(
            &verdict,
            &format!("predictions of scene {}", manifest.scene),
        );
    }
}

fn output(manifest: &PredictionManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

/// Returns the output of a task whose predictions exist; `None` if they are missing or damaged.
///
/// # Errors
/// [`TaskError::User`] if another task has published predictions of the scene.
pub(crate) fn adopted(
    stores: &Stores,
    predictions: &Predictions,
    ours: &PredictionManifest,
    control: &Control,
) -> Result<Option<Output>, TaskError> {
    let looked = async {
        match predictions.finished(ours.scene, &ours.task_key).await {
            Err(error @ StorageError::Damaged { .. }) => {
                warn!(%error, "what was predicted is damaged; it is predicted again and put back");
                Ok(None)
            }
            other => other,
        }
    };
    let there = stores.wait(control, looked)?;
    Ok(there.map(|there| {
        tell(&there);
        output(&there, true)
    }))
}

/// Publishes predictions, and puts back objects that were missing or changed.
///
/// # Errors
/// [`TaskError`] if the store refuses, or has other bytes.
pub(crate) fn publish(
    stores: &Stores,
    predictions: &Predictions,
    encoded: &EncodedPredictions,
    control: &Control,
) -> Result<Output, TaskError> {
    let written = stores.patiently(control, async || predictions.restore(encoded).await)?;
    for object in written {
        info!(%object, "was missing or changed, and is put back");
    }
    tell(&encoded.manifest);
    control.at(1.0);
    Ok(output(&encoded.manifest, false))
}
