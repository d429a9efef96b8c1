//! An error about a field of a job, and the check of a number against a range.

/// An invalid field of a job.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {what}")]
pub struct SpecError {
    /// The field, as in the job file, e.g. `render.bin_width_m`.
    pub field: String,
    /// The expected value and the correction.
    pub what: String,
}

impl SpecError {
    /// The header of a refusal that names the field, for programs: its words are for people.
    pub const HEADER: &str = "picofarm-field";

    /// An error at `field`.
    pub fn new(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self {
            field: field.into(),
            what: what.into(),
        }
    }
}

/// Checks that a value is in a range, ends included. `unit` names the unit, and may continue after
/// a semicolon with a hint for finding the right value.
pub(super) fn within<T: PartialOrd + std::fmt::Display>(
    field: impl Into<String>,
    value: T,
    (low, high): (T, T),
    unit: &str,
) -> Result<(), SpecError> {
    if value >= low && value <= high {
        return Ok(());
    }
    let what = format!("{value} lies outside {low}..={high} {unit}");
    Err(SpecError::new(field, what.trim_end()))
}
