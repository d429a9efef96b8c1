//! Names of models, splits and predictions.

use crate::spec::spec_error::SpecError;

/// Checks the name of a model, which is also the name of a folder.
///
/// # Errors
/// Returns a [`SpecError`] for the field.
pub fn check_model(field: &str, name: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if (1..=128).contains(&name.len()) && !name.starts_with('.') && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!(
        "{name:?} must be up to 128 letters, digits, '-', '_' and '.', and not begin with '.'"
    );
    Err(SpecError::new(field, what))
}

/// Checks the name of a split.
pub(super) fn check_split(field: &str, name: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    if (1..=64).contains(&name.len()) && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!("{name:?} must be up to 64 letters, digits, '-' and '_'");
    Err(SpecError::new(field, what))
}

/// Checks a source of two-bounce times: `truth`, or the folder of predictions.
pub(super) fn check_times(field: &str, name: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if !name.is_empty() && !name.starts_with('.') && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!(
        "is {name:?}; give \"truth\", an infer stage, or the plain name of a folder that one wrote"
    );
    Err(SpecError::new(field, what))
}

/// Checks the folder of predictions.
pub(super) fn check_predictions(field: &str, name: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if !name.is_empty() && !name.starts_with('.') && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!(
        "is {name:?}; give a demultiplex or infer stage, or the plain name of a folder that one wrote"
    );
    Err(SpecError::new(field, what))
}
