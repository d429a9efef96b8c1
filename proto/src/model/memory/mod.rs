//! How much memory a task takes at most, from its settings and what is known of what it reads. Plain arithmetic: the
//! coordinator places tasks by it, plans say it, and workers refuse by it, before anything is made.
//!
//! The constants are measured (`tests/tests/memory.rs`, which compares these numbers with the largest memory of
//! processes that run each kind of task): estimates lie within a factor of two above, and not more than a quarter below.

mod job;
mod known;
mod network;
mod rendering;
mod shape;

pub use job::peak_bytes;
pub use known::Known;
pub use network::Network;
pub(super) use rendering::LIGHT_PATHS;
pub use rendering::Rendering;
pub(super) use shape::BASE;
pub use shape::{Shape, gib};

#[cfg(test)]
mod tests;
