//! Substitute for PlatoNeRF's networks in a build without networks. Such a worker does not offer
//! them.

use picofarm_proto::spec::kinds::ReconstructTask;
use picofarm_reconstruct::{Measured, Reconstructed, Settings};
use picofarm_results::{Checkpoints, ReconstructionManifest, Reconstructions};
use picofarm_settings::MlpSettings;

use crate::{
    stores::Stores,
    task::{Control, TaskError},
};

/// Error message with the build option that adds them.
pub const NOT_BUILT: Option<&str> = Some(
    "is \"mlp\", but this picofarm was built without networks; build it with `--features networks`",
);

/// Returns an error, because this build has no networks.
pub fn fit(
    _: Measured,
    _: (&Settings, &MlpSettings),
    _: (&Stores, Checkpoints),
    _: &super::Watch<'_>,
) -> Result<Reconstructed, TaskError> {
    let what = NOT_BUILT.unwrap_or_default();
    Err(TaskError::User(format!("reconstruct.field {what}")))
}

/// Does nothing, because this build writes no checkpoints.
pub fn forget(
    _: &ReconstructTask,
    _: &Reconstructions,
    _: &ReconstructionManifest,
    _: (&Stores, &Control),
) -> Result<(), TaskError> {
    Ok(())
}
