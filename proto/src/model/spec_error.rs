//! What is wrong with a field of a job, and the check of a number against a range.

/// A field of a job that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {what}")]
pub struct SpecError {
    /// The field, as in the job file, e.g. `render.bin_width_m`.
    pub field: String,
    /// What was expected and how to correct it.
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

/// Checks that a value lies in a range, ends included. `unit` says what it counts, and may go on after a semicolon with how
/// to find the right value.
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
