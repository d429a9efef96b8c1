//! What can go wrong here.

/// An error of the model runtime.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// A setting that cannot be used; says what was expected.
    #[error("{field}: {what}")]
    Invalid {
        /// The setting.
        field: String,
        /// What is wrong, what was expected, how to correct it.
        what: String,
    },
    /// Bytes that are no file of weights.
    #[error("{what}")]
    File {
        /// What is wrong with them.
        what: String,
    },
    /// Weights that no network can compute with.
    #[error("{what}")]
    Values {
        /// Which tensor, what it holds, and what was expected.
        what: String,
    },
    /// A network that answers with what is no finite number.
    #[error("{what}")]
    Answer {
        /// The scene, by its index among the scenes given, where there are several.
        scene: Option<usize>,
        /// Where, and what is likely at fault.
        what: String,
    },
    /// Weights or a checkpoint that do not belong to this network, or are damaged.
    #[error("{what}")]
    Weights {
        /// What is wrong, and with which tensor.
        what: String,
    },
    /// A scene that could not be read.
    #[error("scene {scene}: {source}")]
    Scene {
        /// Its index among the scenes given.
        scene: usize,
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Training produced a number that is none.
    #[error(
        "step {step}: {what}; the last whole checkpoint is kept. Lower optimise.learning_rate, or use precision = \"f32\""
    )]
    NotFinite {
        /// Optimiser step, from 0.
        step: u64,
        /// Which quantity, and where it was first seen.
        what: String,
    },
    /// A graphics processor that failed.
    #[error("graphics processor {id}: {what}")]
    Gpu {
        /// Which, e.g. `cuda:0`.
        id: String,
        /// What it did, in its driver's words where it has some.
        what: String,
    },
    /// What keeps a process from training together with others.
    #[error("{0}")]
    Group(String),
}

impl ModelError {
    /// An unusable setting.
    pub fn invalid(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            field: field.into(),
            what: what.into(),
        }
    }

    /// Bytes that are no file of weights.
    pub(crate) fn file(what: impl Into<String>) -> Self {
        Self::File { what: what.into() }
    }

    /// The same, with the scene of an answer where that is not known yet.
    pub(crate) fn in_scene(self, index: usize) -> Self {
        match self {
            Self::Answer { scene: None, what } => Self::Answer {
                scene: Some(index),
                what,
            },
            other => other,
        }
    }

    /// Unusable weights.
    pub fn weights(what: impl Into<String>) -> Self {
        Self::Weights { what: what.into() }
    }
}
