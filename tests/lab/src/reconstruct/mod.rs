//! Benchmarks of reconstructions.

pub mod agreement;
pub mod chair;
pub mod plato;
