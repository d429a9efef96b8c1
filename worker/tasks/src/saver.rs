//! Saves checkpoints of long tasks.

use std::time::{Duration, Instant};

use picofarm_results::{Checkpoints, Pieces};
use picofarm_store::StorageError;
use tokio::task::JoinHandle;
use tracing::{debug, warn};

use crate::stores::Stores;

/// Maximum time that a stopping task may take for its last checkpoint.
const LAST_SAVE: Duration = Duration::from_secs(240);

/// Size of a piece of a checkpoint, in bytes. Each piece is one request, and a few are written or
/// read at once.
pub(crate) const PIECE: usize = 64 << 20;

/// Saves checkpoints in the background, one at a time.
pub(crate) struct Saver<'a> {
    stores: &'a Stores,
    checkpoints: Checkpoints,
    under_way: Option<JoinHandle<Result<(), StorageError>>>,
}

impl<'a> Saver<'a> {
    pub(crate) fn new(stores: &'a Stores, checkpoints: Checkpoints) -> Self {
        Self {
            stores,
            checkpoints,
            under_way: None,
        }
    }

    /// Returns whether the previous checkpoint is still being written.
    pub(crate) fn is_busy(&self) -> bool {
        self.under_way
            .as_ref()
            .is_some_and(|task| !task.is_finished())
    }

    /// Starts to save a checkpoint, after waiting for the previous one.
    pub(crate) fn save(&mut self, step: u64, content: Pieces) {
        self.last();
        let checkpoints = self.checkpoints.clone();
        let put = async move {
            let begun = Instant::now();
            checkpoints.put(step, content).await?;
            debug!(
                "the checkpoint after {step} steps was written in {:.2} s",
                begun.elapsed().as_secs_f64()
            );
            Ok(())
        };
        self.under_way = Some(self.stores.runtime().spawn(put));
    }

    /// Waits for the checkpoint in progress. If saving it fails, the task resumes from the previous
    /// one.
    pub(crate) fn last(&mut self) {
        let Some(under_way) = self.under_way.take() else {
            return;
        };
        let within = async { tokio::time::timeout(LAST_SAVE, under_way).await };
        match self.stores.runtime().block_on(within) {
            Ok(Ok(Ok(()))) => {}
            Ok(Ok(Err(error))) => warn!(%error, "a checkpoint was not saved"),
            Ok(Err(error)) => warn!(%error, "a checkpoint was not saved: saving broke down"),
            Err(_) => warn!(
                "a checkpoint was not saved within {} s",
                LAST_SAVE.as_secs()
            ),
        }
    }
}
