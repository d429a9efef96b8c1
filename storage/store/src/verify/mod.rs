//! Checks of objects against the entries of their manifest, and reports of such checks.

pub(crate) mod object;
pub(crate) mod report;

pub use object::{inspect, read_intact};
pub use report::{Fault, Problem, RecordKind, Remedy, Verification, VerifyMode, Watch};
