//! Saves what long tasks have reached.

use std::time::Duration;

use bytes::Bytes;
use picofarm_dataset::{Checkpoints, DatasetError};
use tokio::task::JoinHandle;
use tracing::warn;

use crate::execute::output::Stores;

/// How long a task that shall stop may take to save what it has reached.
const LAST_SAVE: Duration = Duration::from_secs(240);

/// Saves checkpoints while the task goes on, one at a time.
pub(super) struct Saver<'a> {
    stores: &'a Stores,
    checkpoints: Checkpoints,
    under_way: Option<JoinHandle<Result<(), DatasetError>>>,
}

impl<'a> Saver<'a> {
    pub(super) fn new(stores: &'a Stores, checkpoints: Checkpoints) -> Self {
        Self {
            stores,
            checkpoints,
            under_way: None,
        }
    }

    pub(super) fn save(&mut self, step: u64, content: Bytes) {
        self.last();
        let checkpoints = self.checkpoints.clone();
        let put = async move { checkpoints.put(step, content).await };
        self.under_way = Some(self.stores.runtime().spawn(put));
    }

    /// Waits for the checkpoint that is under way. Without it, the task goes on from the one before.
    pub(super) fn last(&mut self) {
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
