//! The coordinator's state in memory, with synchronous methods and no I/O. Times and ids are
//! arguments. Each method records the changes that must become durable ([`Changes`]) and the
//! messages to send afterwards ([`Say`]).
//!
//! The state contains the active jobs, the ranges leased to workers that are connected or may
//! reconnect, and the pending ranges claimed for them. The catalog has everything else.

mod blocklist;
mod budget;
mod candidate;
mod claims;
mod clock;
mod commit;
mod dispatch;
mod doubt;
mod ends;
mod facts;
mod failures;
mod fits;
mod history;
mod jobs;
#[cfg(test)]
mod laws;
mod leases;
mod load;
mod log;
mod message;
mod overlay;
mod placement;
pub(crate) mod plan;
mod progress;
mod ready;
mod refused;
mod sessions;
mod settings;
mod shared;
mod sick;
mod stage;
mod stages;
mod state;
mod stores;
mod tail;
#[cfg(test)]
mod tests;
mod transition;
mod words;
mod workers;

pub use budget::Backoff;
pub(crate) use candidate::{Candidate, NotEligible, RunningOn};
pub use clock::Clock;
pub(crate) use commit::OutputHint;
pub(crate) use doubt::Reported;
pub(crate) use facts::{JobLook, Look};
pub(crate) use fits::{Fit, Fits};
pub(crate) use jobs::{Learnt, Timings};
pub(crate) use message::{Say, SessionId};
pub(crate) use overlay::{Overlay, recorded_status};
pub(crate) use settings::Settings;
pub use settings::VERSION;
pub(crate) use state::Core;
pub(crate) use words::span;
