//! Passes a trace between processes as a `traceparent` of W3C Trace Context: in a lease on its way
//! to the worker, and in the report of a task on its way back. Spans are those of `tracing`. If the
//! subscriber has no OpenTelemetry layer, or the program was built without the feature `traces`,
//! there are no traces and the texts are empty.

/// Target of the spans in a trace.
pub const TARGET: &str = "picofarm::trace";

#[cfg(feature = "traces")]
mod context;
#[cfg(feature = "traces")]
pub use context::{join, traceparent};

/// Does nothing, because this program was built without traces.
#[cfg(not(feature = "traces"))]
pub fn traceparent(_: &tracing::Span) -> String {
    String::new()
}

/// Does nothing, because this program was built without traces.
#[cfg(not(feature = "traces"))]
pub fn join(_: &tracing::Span, _: &str) {}
