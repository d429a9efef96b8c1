//! Conversions between wire types and the model. Every error names the invalid field.

mod audit;
mod examine;
mod explain;
mod job;
mod session;
mod status;
mod usage;

use std::str::FromStr;

use crate::spec::SpecError;

/// An invalid wire message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConvertError {
    /// A required field is missing.
    #[error("{field} is missing")]
    Missing {
        /// The field.
        field: &'static str,
    },
    /// A field's value is invalid.
    #[error("{field}: {what}")]
    Invalid {
        /// The field.
        field: &'static str,
        /// The expected value.
        what: String,
    },
    /// A job's field is outside its limits.
    #[error(transparent)]
    Spec(#[from] SpecError),
}

fn required<T>(value: Option<T>, field: &'static str) -> Result<T, ConvertError> {
    value.ok_or(ConvertError::Missing { field })
}

fn parse<T: FromStr>(text: &str, field: &'static str) -> Result<T, ConvertError>
where
    T::Err: std::fmt::Display,
{
    text.parse().map_err(|e: T::Err| ConvertError::Invalid {
        field,
        what: e.to_string(),
    })
}

/// Converts a failed check to an error about the field.
fn checked<T>(value: Result<T, String>, field: &'static str) -> Result<T, ConvertError> {
    value.map_err(|what| ConvertError::Invalid { field, what })
}

/// Checks that a list has at most `most` entries.
fn at_most<T>(list: Vec<T>, most: usize, field: &'static str) -> Result<Vec<T>, ConvertError> {
    let what = || format!("{} entries; at most {most} are allowed", list.len());
    match list.len() > most {
        true => Err(ConvertError::Invalid {
            field,
            what: what(),
        }),
        false => Ok(list),
    }
}
