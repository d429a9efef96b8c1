//! Substitute for predictions of times and masks in a build without networks.

use picofarm_reconstruct::Measured;
use picofarm_scene::Scene;
use serde_json::Value;

use super::watch::Watch;
use crate::{
    args::Reconstruct,
    error::{Result, not_built},
};

/// Uninhabited, because there are no networks.
pub enum Networks {}

/// Returns an error, because this build has no networks.
///
/// # Errors
/// Always fails.
pub async fn read(_: &Reconstruct, _: usize) -> Result<Networks> {
    Err(not_built("networks", "networks"))
}

/// Cannot be called.
///
/// # Errors
/// None.
pub fn measure(
    _: &Reconstruct,
    _: &Scene,
    networks: &Networks,
    _: usize,
    _: &Watch,
) -> Result<(Measured, Value)> {
    match *networks {}
}
