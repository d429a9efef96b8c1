//! The errors of the model runtime.

/// An error of the model runtime.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// A setting that cannot be used.
    #[error("{field}: {what}")]
    Invalid {
        /// The setting's name.
        field: String,
        /// The fault, the accepted values, and how to correct the setting.
        what: String,
    },
    /// Bytes that are not a valid weights file.
    #[error("{what}")]
    File {
        /// The fault.
        what: String,
    },
    /// Weights with which no network can compute.
    #[error("{what}")]
    Values {
        /// The tensor, its invalid value, and the accepted values.
        what: String,
    },
    /// A network that answered with a non-finite number.
    #[error("{what}")]
    Answer {
        /// The scene's index among the scenes given, if there are several.
        scene: Option<usize>,
        /// The position of the number, and the likely cause.
        what: String,
    },
    /// Weights or a checkpoint that do not belong to this network, or are damaged.
    #[error("{what}")]
    Weights {
        /// The fault, and the tensor that has it.
        what: String,
    },
    /// A scene that could not be read.
    #[error("scene {scene}: {source}")]
    Scene {
        /// Its index among the scenes given.
        scene: usize,
        /// The cause.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A quantity of training that became NaN or infinite.
    #[error(
        "step {step}: {what}; the last whole checkpoint is kept. Lower optimise.learning_rate, or use precision = \"f32\""
    )]
    NotFinite {
        /// The optimiser step, from 0.
        step: u64,
        /// The quantity, and the place where it was first seen.
        what: String,
    },
    /// A graphics processor that failed.
    #[error("graphics processor {id}: {what}")]
    Gpu {
        /// The device's name, e.g. `cuda:0`.
        id: String,
        /// The failure, in the driver's words if it gave any.
        what: String,
    },
    /// A failure of the program that computes a training's steps.
    #[error("{0}")]
    Engine(String),
    /// The reason why a process cannot train together with others.
    #[error("{0}")]
    Group(String),
}

impl ModelError {
    /// Returns the error for a setting that cannot be used.
    pub fn invalid(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            field: field.into(),
            what: what.into(),
        }
    }

    /// Returns the error for bytes that are not a valid weights file.
    pub(crate) fn file(what: impl Into<String>) -> Self {
        Self::File { what: what.into() }
    }

    /// Adds the scene's index to an [`Self::Answer`] that has none yet.
    pub(crate) fn in_scene(self, index: usize) -> Self {
        match self {
            Self::Answer { scene: None, what } => Self::Answer {
                scene: Some(index),
                what,
            },
            other => other,
        }
    }

    /// Returns the error for weights that cannot be used.
    pub fn weights(what: impl Into<String>) -> Self {
        Self::Weights { what: what.into() }
    }
}
