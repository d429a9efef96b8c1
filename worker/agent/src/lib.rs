//! The worker: a session with the coordinator, the leases it holds, and the executors that turn a task
//! into a published scene. Knows the wire, the data set, scenes and the renderer; never the catalog.
//!
//! [`run`] is the whole worker; [`run_with`] takes another [`Executor`], which is how tests look at the
//! session without rendering. The features `networks` and `clouds` bring the kinds of task that train networks, and stores
//! over a network.

mod access;
mod agent;
mod allow;
mod config;
pub mod execute;
mod log;
mod machine;
mod session;
mod suspend;

pub use access::{Access, AccessError, Bearer, Target, Trouble, lost_connection};
pub use agent::{run, run_with};
pub use allow::StorePrefixes;
pub use config::{AgentConfig, AgentError, Summary};
pub use execute::{Control, Executor, Output, Task, TaskError};
pub use execute::{
    Submission, TaskExecutor, absolute, check_memory, render_bytes, renderer_version, resolve,
    strategy, strategy_names,
};
pub use execute::{export, repair, reprocess, split};
#[cfg(feature = "networks")]
pub use execute::{infer_version, model_version, report};
pub use log::task_logs;
pub use machine::{Memory, MemoryLimit, cores, memory_mib};
