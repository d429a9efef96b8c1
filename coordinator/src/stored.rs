//! What a coordinator asks of stores: whether results that are recorded lie there. It links no code that reads stores;
//! who starts it may hand some in.

use std::fmt;

use futures::future::BoxFuture;
use picofarm_proto::model::StageSpec;

/// What a store holds of a recorded result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Found {
    /// What was reported.
    Equal,
    /// Nothing, or only a part.
    Gone,
    /// Something else.
    Differs,
    /// Nothing, because this machine has no folder at the store's place. Whether results were deleted, or only workers reach
    /// the store, cannot be told.
    NoFolder,
    /// Nothing, because there is no folder at the store's place. This machine has the folder around it.
    NoStore,
}

/// Looks into stores. Its caller bounds how long it waits and how many ask at a time.
pub trait Stored: fmt::Debug + Send + Sync + 'static {
    /// Whether results of tasks of `stage` lie in its store as they were reported (task and SHA-256 of its manifest), in
    /// the same order.
    ///
    /// # Errors
    /// Why that cannot be found out from here, in words that follow "because": the store is not one that may be looked into, it
    /// cannot be read, or the kind of stage keeps nothing that tells.
    fn look<'a>(
        &'a self,
        stage: &'a StageSpec,
        results: &'a [(u64, [u8; 32])],
    ) -> BoxFuture<'a, Result<Vec<Found>, String>>;
}
