//! Wire → model and back. Every error names the field that cannot be used.

mod audit;
mod explain;
mod job;
mod session;
mod status;

use std::str::FromStr;

use crate::model::SpecError;

/// A wire message that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConvertError {
    /// A field that must be there is not.
    #[error("{field} is missing")]
    Missing {
        /// The field.
        field: &'static str,
    },
    /// A field's value cannot be read.
    #[error("{field}: {what}")]
    Invalid {
        /// The field.
        field: &'static str,
        /// What was expected.
        what: String,
    },
    /// A job's field lies outside its limits.
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

/// What is wrong with a field, where something is.
fn checked<T>(value: Result<T, String>, field: &'static str) -> Result<T, ConvertError> {
    value.map_err(|what| ConvertError::Invalid { field, what })
}

/// A list of at most so many.
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
