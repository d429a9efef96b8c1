//! Runs tasks: the executors that turn a task into published results. The session with the
//! coordinator is a crate of its own, [`picofarm_session`]. This crate depends on the data set,
//! scenes and the renderer, but not on the wire protocol or the catalog.
//!
//! [`run`] is the complete worker. [`run_with`] takes another [`Executor`], so that tests can
//! exercise the session without rendering. The feature `networks` adds the task kinds that train
//! networks, and `clouds` adds stores over a network.
//!
//! The modules form layers. Each module imports only modules of layers below its own, and a kind of
//! task imports no other kind. From the top: `run`, `executor`, `examine`, `kinds`, `repair`,
//! `making`, `input`, `python`, `trial`, `device`, `task`, `interpreter`, `saver`, `stores`,
//! `submission`, `memory`, `errors`.

#[cfg(feature = "networks")]
mod device;
mod errors;
pub mod examine;
mod executor;
mod input;
#[cfg(feature = "networks")]
mod interpreter;
mod kinds;
mod making;
mod memory;
#[cfg(feature = "networks")]
mod python;
pub mod repair;
mod run;
#[cfg(feature = "networks")]
mod saver;
mod stores;
mod submission;
mod task;
#[cfg(feature = "networks")]
mod trial;

pub use executor::{TaskExecutor, resolve};
pub use input::camera::slant;
pub use input::counts;
#[cfg(feature = "networks")]
pub use input::models::{model_version, takes};
pub use kinds::{demultiplex, export, reconstruct, reprocess, split};
#[cfg(feature = "networks")]
pub use kinds::{
    infer::infer_version,
    report,
    train::{ImportFor, NotImported, imported},
};
pub use making::rendered::{By, encode_render, renderer_settings, renderer_version};
pub use memory::{SceneSize, check_memory, render_bytes, scene_size};
pub use picofarm_session::{
    Access, AccessError, AgentConfig, AgentError, Bearer, ConnectionFailure, Control, Executor,
    Memory, MemoryLimit, Output, StorePrefixes, Summary, Target, Task, TaskError, cores,
    lost_connection, memory_mib, run_with, task_logs,
};
pub use run::run;
pub use submission::{Submission, absolute, repin};
