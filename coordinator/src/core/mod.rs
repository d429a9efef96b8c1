//! The coordinator's state in memory, with synchronous methods and no I/O. Times and ids are
//! arguments. Each method records the changes that must become durable, and the messages to send
//! afterwards ([`ToWorker`]).
//!
//! The state contains the active jobs, the ranges leased to workers that are connected or may
//! reconnect, and the pending ranges claimed for them. The catalog has everything else.

mod blocklist;
mod budget;
mod candidate;
mod claims;
mod clock;
mod commit;
mod demand;
mod dispatch;
mod disputes;
mod doubts;
mod eligible_workers;
mod expiry;
mod failing_workers;
mod failures;
mod forecast;
mod held_ranges;
mod history;
mod jobs;
#[cfg(test)]
mod laws;
mod lease_state;
mod leases;
mod load;
mod log;
mod message;
mod outcome;
mod overlay;
mod peers;
mod placement;
pub(crate) mod plan;
mod pools;
mod progress;
mod quota;
mod ready;
mod refunds;
mod refused;
mod reports;
mod second_runs;
mod sessions;
mod settings;
mod shared;
mod snapshot;
mod stage_entry;
mod stages;
mod state;
mod store_faults;
mod tail;
#[cfg(test)]
mod tests;
mod time_left;
mod transition;
mod usage;
mod words;
mod workers;

pub use budget::Backoff;
pub(crate) use candidate::{Candidate, NotEligible, RunningOn};
pub use clock::Clock;
pub(crate) use commit::OutputHint;
pub(crate) use demand::Demand;
pub(crate) use disputes::Reported;
pub(crate) use eligible_workers::{EligibleWorkers, StageWorkers};
pub(crate) use jobs::{NewJob, Timings};
pub(crate) use message::{SessionId, ToWorker};
pub(crate) use overlay::{Overlay, recorded_status};
pub(crate) use pools::{PoolFit, Shape};
pub(crate) use quota::over_bytes;
pub(crate) use sessions::{Asked, AskedWorker};
pub use settings::VERSION;
pub(crate) use settings::{Bound, Settings, UserQuotas};
pub(crate) use snapshot::{FarmSnapshot, JobSnapshot};
pub(crate) use state::Core;
pub(crate) use words::span;
