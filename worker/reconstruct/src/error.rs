//! Why a reconstruction cannot be made.

use picofarm_transient::RenderError;

/// Why a reconstruction cannot be made or scored.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    /// A value is unusable.
    #[error("{field}: {what}")]
    Invalid {
        /// Field, e.g. `spots[3].path_m`.
        field: String,
        /// What was found, what was expected, and how to mend it.
        what: String,
    },
    /// The measurements contradict one another.
    #[error("the measurements contradict one another: {}", reasons.join("; "))]
    Inconsistent {
        /// Why, a sentence each.
        reasons: Vec<String>,
    },
    /// The renderer that made the measurements or the truth refused.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// [`crate::Progress::at`] asked to stop before there was anything to keep.
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
