//! The errors of reconstructions.

use picofarm_transient::RenderError;

/// The reason why a reconstruction cannot be made or scored.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    /// A value cannot be used.
    #[error("{field}: {what}")]
    Invalid {
        /// The field, e.g. `spots[3].path_m`.
        field: String,
        /// The value, the expected values, and how to correct it.
        what: String,
    },
    /// The measurements contradict one another.
    #[error("the measurements contradict one another: {}", reasons.join("; "))]
    Inconsistent {
        /// The reasons, a sentence each.
        reasons: Vec<String>,
    },
    /// The renderer that makes the measurements or the truth failed.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// [`crate::Progress::at`] requested a stop before there was a result.
    #[error("reconstruction stopped on request")]
    Stopped,
}

impl ReconstructError {
    pub(crate) fn invalid(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            field: field.into(),
            what: what.into(),
        }
    }
}
