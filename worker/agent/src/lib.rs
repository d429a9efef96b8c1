//! The worker: a session with the coordinator (its own crate, [`picofarm_session`]) and the
//! executors that turn a task into a published scene. This crate depends on the data set, scenes
//! and the renderer, but not on the wire protocol or the catalog.
//!
//! [`run`] is the complete worker. [`run_with`] takes another [`Executor`], so that tests can
//! exercise the session without rendering. The feature `networks` adds the task kinds that train
//! networks, and `clouds` adds stores over a network.

pub mod execute;
mod run;

pub use execute::{
    By, SceneSize, Submission, TaskExecutor, absolute, check_memory, encode_render, render_bytes,
    renderer_settings, renderer_version, repin, resolve, scene_size,
};
#[cfg(feature = "networks")]
pub use execute::{ImportFor, NotImported, imported, infer_version, model_version, report, takes};
pub use execute::{demultiplex, export, reconstruct, repair, reprocess, split};
pub use picofarm_session::{
    Access, AccessError, AgentConfig, AgentError, Bearer, ConnectionFailure, Control, Executor,
    Memory, MemoryLimit, Output, StorePrefixes, Summary, Target, Task, TaskError, cores,
    lost_connection, memory_mib, run_with, task_logs,
};
pub use run::run;
