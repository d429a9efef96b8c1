//! The coordinator's interface to stores, which checks whether recorded results exist. The
//! coordinator links no code that reads stores; the program that starts it may provide some.

use std::fmt;

use futures::future::BoxFuture;
use picofarm_proto::spec::StageSpec;

/// The state of a recorded result in its store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResultState {
    /// The reported result.
    Equal,
    /// Nothing, or only a part.
    Gone,
    /// A different result.
    Differs,
    /// Nothing, because this machine has no folder at the store's place. Either the results were
    /// deleted, or only workers can reach the store.
    NoFolder,
    /// Nothing, because there is no folder at the store's place. This machine has the parent
    /// folder.
    NoStore,
}

/// Reads stores. The caller bounds the waiting time and the concurrency.
pub trait ResultReader: fmt::Debug + Send + Sync + 'static {
    /// Checks whether results of `stage`'s tasks exist in its store as reported. Each is given by
    /// its task and the SHA-256 of its manifest. The answers have the same order.
    ///
    /// # Errors
    /// Returns why this cannot be determined here, in words that follow "because". The store may be
    /// out of bounds or unreadable, or the kind of stage stores nothing to check.
    fn check<'a>(
        &'a self,
        stage: &'a StageSpec,
        results: &'a [(u64, [u8; 32])],
    ) -> BoxFuture<'a, Result<Vec<ResultState>, String>>;
}
