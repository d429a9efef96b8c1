//! Runs tasks: the kinds, and the code that they share.

#[cfg(feature = "networks")]
mod examples;
#[cfg(feature = "networks")]
mod gallery;
mod kinds;
mod memory;
mod output;
mod predicted;
mod recipe;
mod remade;
pub mod repair;
mod scenes;
mod submission;
mod subsets;
#[cfg(feature = "networks")]
mod times;
#[cfg(feature = "networks")]
mod truth;

pub use picofarm_session::{Control, Executor, Output, Task, TaskError};

use kinds::{Context, RunTask, STORE_PATIENCE, part, render};
pub use kinds::{
    TaskExecutor, demultiplex, export, reconstruct,
    render::{By, encode_render, renderer_settings, renderer_version},
    reprocess, resolve, split,
};
#[cfg(feature = "networks")]
use kinds::{evaluate, train};
#[cfg(feature = "networks")]
pub use kinds::{
    infer::infer_version,
    report,
    train::{ImportFor, NotImported, imported, model_version, takes},
};
pub use memory::{SceneSize, check_memory, render_bytes, scene_size};
pub use submission::{Submission, absolute, repin};
