//! What is known of what a task reads.

use super::{network::Network, shape::Shape};

/// What is known of what a task reads.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Known {
    /// The scenes of the data set; `None` where only the store tells.
    pub source: Option<Shape>,
    /// The networks of the models that it asks, as far as they are known.
    pub networks: Vec<Network>,
}
