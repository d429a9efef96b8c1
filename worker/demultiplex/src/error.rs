//! Why a capture cannot be taken apart.

/// Why a capture cannot be taken apart.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DemultiplexError {
    /// An argument is unusable.
    #[error("{argument}: {what}")]
    Invalid {
        /// The argument, e.g. `spots[3].place.path_m`.
        argument: String,
        /// What was found, what was expected, and how to mend it.
        what: String,
    },
    /// No spot has a place: neither given nor seen in the histogram.
    #[error(
        "spots: none of {count} spots has a one-bounce return in the histogram; give their places, or a gate that holds it"
    )]
    NoReturn {
        /// Spots that were asked for.
        count: usize,
    },
}

impl DemultiplexError {
    pub(crate) fn invalid(argument: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            argument: argument.into(),
            what: what.into(),
        }
    }

    /// Names the spot that an argument is about.
    pub(crate) fn in_spot(self, spot: usize) -> Self {
        match self {
            Self::Invalid { argument, what } => Self::Invalid {
                argument: format!("capture of spot {spot}: {argument}"),
                what,
            },
            other => other,
        }
    }
}
