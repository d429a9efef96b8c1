//! Checks of objects against the entries of their manifest, and reports of such checks.

pub(crate) mod object;
pub(crate) mod report;

pub use object::{intact, looked_at};
pub use report::{Fault, Problem, Verification, VerifyMode, Watch};
