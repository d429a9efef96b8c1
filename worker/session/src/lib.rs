//! A worker's session with the coordinator: the connection, the leases, the unacknowledged reports,
//! and the thread that runs tasks. This crate knows the wire protocol, but no kinds of tasks; these
//! are behind [`Executor`].

mod access;
mod agent;
mod allow;
mod assignments;
#[cfg(test)]
mod assignments_laws;
mod backoff;
mod config;
mod examine;
mod executor;
mod lanes;
mod log;
mod machine;
mod message;
mod outbox;
mod runner;
mod session;
mod suspend;

pub use access::{Access, AccessError, Bearer, ConnectionFailure, Target, lost_connection};
pub use agent::run_with;
pub use allow::{StorePrefixes, opener};
pub use backoff::{Backoff, random};
pub use config::{AgentConfig, AgentError, Summary};
pub use executor::{Control, Executor, Output, Task, TaskError};
pub use log::task_logs;
pub use machine::{Memory, MemoryLimit, cores, memory_mib};
