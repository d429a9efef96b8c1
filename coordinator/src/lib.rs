//! The coordinator plans jobs, places their tasks on workers, leases ranges of them, and commits
//! the results. [`serve`] runs one. The decisions are pure ([`plan`], [`place`], [`transition`],
//! [`budget`], [`explain`]).

mod actor;
mod audit;
pub mod auth;
pub mod budget;
mod clock;
mod connections;
mod core;
pub mod explain;
mod forget;
mod health;
mod http;
mod lanes;
#[cfg(test)]
mod laws;
mod memory;
mod metrics;
pub mod place;
pub mod plan;
mod rpc;
mod server;
mod sessions;
pub mod stage;
mod stored;
mod submission;
mod timed;
mod trace;
pub mod transition;

pub use budget::Backoff;
pub use clock::Clock;
pub use connections::Connections;
pub use memory::MemoryBounds;
pub use server::{CoordinatorConfig, CoordinatorError, MAX_MESSAGE_BYTES, Running, serve};
pub use stored::{Found, Stored};

/// Version of this program. Workers must have the same.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
