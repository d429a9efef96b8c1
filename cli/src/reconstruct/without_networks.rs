//! Says that there are no networks to predict times and masks.

use picofarm_reconstruct::Measured;
use picofarm_scene::Scene;
use serde_json::Value;

use super::watch::Watch;
use crate::{
    args::Reconstruct,
    error::{Result, not_built},
};

/// There are none.
pub enum Networks {}

/// Says so.
///
/// # Errors
/// Always.
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
