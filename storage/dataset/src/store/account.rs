//! Reports on failures of a store.

/// An error of a store in words.
pub(crate) struct Failure {
    /// What happened.
    pub account: String,
    /// How to repair it, where known.
    pub hint: Option<&'static str>,
}
