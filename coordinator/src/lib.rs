//! The coordinator plans jobs, places their tasks on workers, leases ranges of them, and commits
//! the results. [`serve`] runs one.
//!
//! The folders import one way, each from those listed before it:
//!
//! | folder | responsibility |
//! | --- | --- |
//! | `core` | the state in memory and all decisions; pure |
//! | `memory` | bounds on the memory that callers can make the coordinator use |
//! | `observe` | metrics, health, the audit log, trace spans |
//! | `auth` | callers, their credentials and rights |
//! | `explain` | why a task does not run, and why it ran again; pure |
//! | `actor` | owns the core, and commits its decisions to the catalog |
//! | `submission` | plans and records jobs outside the actor |
//! | `edge` | connections, gRPC services, HTTP pages, start and stop |
//!
//! `auth` is a folder of its own and not a part of `edge`, because a submission depends on the
//! rights of its caller. `tests/it/layers.rs` checks the order.

mod actor;
pub mod auth;
mod core;
mod edge;
mod explain;
mod memory;
mod observe;
mod submission;

pub use core::{Backoff, Clock, VERSION};
pub use edge::{Connections, CoordinatorConfig, CoordinatorError, Running, serve};
pub use memory::MemoryBounds;
pub use submission::{ResultReader, ResultState};
