//! Heavy work beside the actor: on threads of its own, and so much of it at a time that memory and the catalog's
//! connections are not used up. Heartbeats and reports wait for none of it.

use std::{future::Future, panic, sync::Arc};

use tokio::{
    runtime::Handle,
    sync::{OwnedSemaphorePermit, Semaphore},
};
use tokio_util::sync::CancellationToken;

/// Reads of the catalog at a time; it has more connections than that.
const READS: usize = 4;
/// Requests with small specs at a time.
const SMALL: usize = 8;
/// From here on a spec is large, bytes.
const LARGE: usize = 1 << 20;
/// Large specs in hand together, KiB as sent: two of the largest. In memory each takes several times as much.
const LARGE_KIB: usize = 96 << 10;

/// What may run at a time.
#[derive(Debug, Clone)]
pub(crate) struct Lanes {
    reads: Arc<Semaphore>,
    small: Arc<Semaphore>,
    large: Arc<Semaphore>,
    /// The program ends: what runs is given up.
    stop: CancellationToken,
}

impl Lanes {
    pub(crate) fn new(stop: CancellationToken) -> Self {
        let semaphore = |permits| Arc::new(Semaphore::new(permits));
        Self {
            reads: semaphore(READS),
            small: semaphore(SMALL),
            large: semaphore(LARGE_KIB),
            stop,
        }
    }

    /// Runs work on a spec that was `bytes` long as sent.
    pub(crate) async fn heavy<T, F>(
        &self,
        bytes: usize,
        work: impl FnOnce() -> F + Send + 'static,
    ) -> T
    where
        T: Send + 'static,
        F: Future<Output = T>,
    {
        let permit = match bytes < LARGE {
            true => self.small.clone().acquire_owned().await,
            false => {
                let kib = (bytes >> 10).min(LARGE_KIB);
                let kib = u32::try_from(kib).expect("less than 96 Ki");
                self.large.clone().acquire_many_owned(kib).await
            }
        };
        self.aside(permit.expect("never closed"), work).await
    }

    /// Runs a read of the catalog, with what is made of it. Never called from within another read.
    pub(crate) async fn read<T, F>(&self, work: impl FnOnce() -> F + Send + 'static) -> T
    where
        T: Send + 'static,
        F: Future<Output = T>,
    {
        let permit = self.reads.clone().acquire_owned().await;
        self.aside(permit.expect("never closed"), work).await
    }

    /// Runs `work` on a thread that may block. It goes on when nobody waits any more, so the permit goes with it.
    async fn aside<T, F>(
        &self,
        permit: OwnedSemaphorePermit,
        work: impl FnOnce() -> F + Send + 'static,
    ) -> T
    where
        T: Send + 'static,
        F: Future<Output = T>,
    {
        let (runtime, stop) = (Handle::current(), self.stop.clone());
        let running = tokio::task::spawn_blocking(move || {
            let done = runtime.block_on(stop.run_until_cancelled(work()));
            drop(permit);
            done
        });
        match running.await {
            Ok(Some(done)) => done,
            Err(error) if error.is_panic() => panic::resume_unwind(error.into_panic()),
            // The program ends, and whoever waits with it.
            Ok(None) | Err(_) => std::future::pending().await,
        }
    }
}
