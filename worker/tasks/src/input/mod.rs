//! Inputs of tasks: scenes, examples for networks, ground truth, times and models.

pub(crate) mod camera;
pub mod counts;
#[cfg(feature = "networks")]
pub(crate) mod examples;
#[cfg(feature = "networks")]
pub(crate) mod models;
pub(crate) mod scenes;
#[cfg(feature = "networks")]
pub(crate) mod sides;
#[cfg(feature = "networks")]
pub(crate) mod times;
#[cfg_attr(
    not(feature = "networks"),
    expect(dead_code, reason = "stages of networks need the rest")
)]
pub(crate) mod truth;

use picofarm_dataset::{Dataset, Manifest, Quantity};
use picofarm_proto::spec::Histogram;
use picofarm_store::StorageError;

use crate::{
    stores::Stores,
    task::{Control, TaskError},
};

/// Returns the source's manifest of a scene. The module documentation explains why a missing
/// manifest is an error.
pub(crate) fn source_manifest(
    stores: &Stores,
    source: &Dataset,
    index: u64,
    control: &Control,
) -> Result<Manifest, TaskError> {
    if index >= source.spec().scenes {
        return Err(TaskError::User(format!(
            "source: scene {index} does not exist: {} has room for {} scenes",
            source.prefix(),
            source.spec().scenes
        )));
    }
    let looked = async {
        match source.manifest(index).await {
            Ok(manifest) => Ok(Ok(manifest)),
            Err(error @ StorageError::NotPublished { .. }) => Ok(Err(error)),
            Err(error) => Err(error),
        }
    };
    stores
        .wait(control, looked)?
        .map_err(|error| TaskError::User(format!("source: scene {index} is not there ({error})")))
}

pub(crate) fn quantity(histogram: Histogram) -> Quantity {
    match histogram {
        Histogram::Transient => Quantity::Transient,
        Histogram::Transient4 => Quantity::Transient4,
        Histogram::Transient25 => Quantity::Transient25,
        Histogram::TransientSpots => Quantity::TransientSpots,
    }
}
