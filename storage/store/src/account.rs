//! Descriptions of store failures.

/// A description of a store's error.
pub(crate) struct Failure {
    /// A description of the failure.
    pub account: String,
    /// How to fix it, if known.
    pub hint: Option<&'static str>,
}
