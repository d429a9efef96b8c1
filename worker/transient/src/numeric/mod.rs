//! Random numbers, SIMD columns, frames and other arithmetic without a scene.

pub(crate) mod double;
pub(crate) mod exponential;
pub(crate) mod frame;
pub(crate) mod lanes;
pub(crate) mod low_discrepancy;
pub(crate) mod rng;
pub(crate) mod systematic;
