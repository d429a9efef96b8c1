//! Substitute for traces in a build without them.

use std::convert::Infallible;

use tracing_subscriber::layer::Identity;

use crate::error::{Result, not_built};

/// Uninhabited, because there are no traces.
pub struct Traces(Infallible);

impl Traces {
    /// Returns an error that names the build option for traces.
    ///
    /// # Errors
    /// Always fails.
    pub fn start(_url: &str, _service: &'static str) -> Result<Self> {
        Err(not_built("traces", "traces (--otlp)"))
    }

    pub fn layer(&self) -> Identity {
        match self.0 {}
    }

    pub fn end(self) {
        match self.0 {}
    }
}
