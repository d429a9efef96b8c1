//! Renders scenes.
use super::*;
use std::path::PathBuf;
/// Renders.
pub struct RenderExecutor;
impl RenderExecutor {
    /// New.
    pub fn new(_: &[PathBuf]) -> Self {
        Self
    }
}
impl Executor for RenderExecutor {
    fn renderer(&self) -> String {
        picofarm_transient::RENDERER_VERSION.into()
    }
    fn assets(&self) -> Vec<String> {
        vec![]
    }
    fn run(&self, _: &Task, _: &Control) -> Result<Output, TaskError> {
        Err(TaskError::Stopped)
    }
}
