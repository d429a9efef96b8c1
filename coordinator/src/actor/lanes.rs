//! Runs heavy work on separate threads, outside the actor. Its concurrency is bounded, so that
//! memory and the catalog's connections suffice. Heartbeats and reports never wait for it.

use std::{future::Future, panic, sync::Arc};

use tokio::{
    runtime::Handle,
    sync::{OwnedSemaphorePermit, Semaphore},
};
use tokio_util::sync::CancellationToken;

/// Concurrent reads of the catalog, which has more connections than that.
const READS: usize = 4;
/// Concurrent requests with small specs.
const SMALL: usize = 8;
/// Smallest size of a large spec, bytes.
const LARGE: usize = 1 << 20;
/// Total size of concurrent large specs as sent, KiB: two of the largest. In memory each takes
/// several times as much.
const LARGE_KIB: usize = 96 << 10;

/// Limits on concurrent work.
#[derive(Debug, Clone)]
pub(crate) struct Lanes {
    reads: Arc<Semaphore>,
    small: Arc<Semaphore>,
    large: Arc<Semaphore>,
    /// Cancelled when the program ends. Running work is abandoned.
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

    /// Runs work on a spec with `bytes` bytes as sent.
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

    /// Runs a read of the catalog with the processing of its result. Never call it within another
    /// read.
    pub(crate) async fn read<T, F>(&self, work: impl FnOnce() -> F + Send + 'static) -> T
    where
        T: Send + 'static,
        F: Future<Output = T>,
    {
        let permit = self.reads.clone().acquire_owned().await;
        self.aside(permit.expect("never closed"), work).await
    }

    /// Runs `work` on a blocking thread. The work continues if nobody waits any more, so it owns
    /// the permit.
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
            // The program is ending, together with the waiting caller.
            Ok(None) | Err(_) => std::future::pending().await,
        }
    }
}
