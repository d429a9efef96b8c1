//! Ground truth and the companion image, from the rays through the pixels.

pub(crate) mod ground_truth;
pub(crate) mod photo;
