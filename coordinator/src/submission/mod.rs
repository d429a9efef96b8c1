//! Plans and submits jobs outside the actor. A spec is compared with the catalog and the stores,
//! and is recorded in one transaction. The actor only learns that there is a new job.
//!
//! An output counts for a new job if it was found in its store. Outputs that a worker reported and
//! nobody has checked since are planned as pending, and a worker looks for them. So are outputs
//! committed while the job is being planned.

mod check;
mod conflicts;
mod consider;
mod draft;
mod evidence;
mod foresee;
mod judge;
mod places;
mod prepare;
mod report;
mod result_reader;
mod service;
mod store_checks;
mod submit;
mod verify;

#[cfg(test)]
pub(crate) use prepare::{prepare, reuses_job};

pub(crate) use draft::Draft;
pub use result_reader::{ResultReader, ResultState};
pub(crate) use service::Submissions;
pub(crate) use submit::UserLimits;
