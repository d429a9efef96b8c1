//! Makes scenes and predictions, for the kinds of task that publish them and for repairs.

pub(crate) mod parts;
pub(crate) mod predicted;
pub(crate) mod rendered;
pub(crate) mod reprocessed;
mod subsets;
