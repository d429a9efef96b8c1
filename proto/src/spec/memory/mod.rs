//! Estimates a task's largest memory from its settings and the known properties of its inputs. The
//! arithmetic is plain. The coordinator places tasks by the estimate, plans show it, and workers
//! refuse tasks by it before they allocate anything.
//!
//! The constants are measured. `tests/tests/it/memory.rs` compares the estimates with the largest
//! memory of processes that run each kind of task. An estimate is at most a factor of two above,
//! and at most a quarter below.

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
pub use shape::{EVIDENCE_PLANES, Shape, gib};

#[cfg(test)]
mod tests;
