//! The known properties of a task's inputs.

use super::{network::Network, shape::Shape};

/// The known properties of a task's inputs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Known {
    /// The scenes of the data set; `None` if only the store contains them.
    pub source: Option<Shape>,
    /// The networks of the models that the task uses, as far as they are known.
    pub networks: Vec<Network>,
}
