//! A store with requests that wait until the bandwidth limit permits them.

use std::ops::Range;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt;
use futures::stream::BoxStream;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetRange, GetResult, GetResultPayload, ListResult, MultipartUpload,
    ObjectMeta, ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions,
    Result,
};
use tokio::time::Instant;

use super::super::bandwidth::{Bandwidth, bandwidth};

static LIMITS: OnceLock<Limits> = OnceLock::new();

/// Returns the limits of this process.
pub(super) fn limits() -> Limits {
    let new = || Limits::new(bandwidth(), &(Arc::new(WallClock) as _));
    LIMITS.get_or_init(new).clone()
}

/// The limits in both directions.
#[derive(Debug, Clone, Default)]
pub(super) struct Limits {
    upload: Option<Arc<Line>>,
    download: Option<Arc<Line>>,
}

impl Limits {
    fn new(bandwidth: Bandwidth, clock: &Arc<dyn Clock>) -> Self {
        let line = |rate: Option<f64>| {
            rate.map(|bytes_per_s| {
                Arc::new(Line {
                    bytes_per_s,
                    free: Mutex::new(None),
                    clock: clock.clone(),
                })
            })
        };
        Self {
            upload: line(bandwidth.upload),
            download: line(bandwidth.download),
        }
    }

    pub(super) fn any(&self) -> bool {
        self.upload.is_some() || self.download.is_some()
    }
}

/// A source of time, with sleeping.
#[async_trait::async_trait]
trait Clock: std::fmt::Debug + Send + Sync {
    fn now(&self) -> Instant;
    async fn wait_until(&self, time: Instant);
}

#[derive(Debug)]
struct WallClock;

#[async_trait::async_trait]
impl Clock for WallClock {
    fn now(&self) -> Instant {
        Instant::now()
    }

    async fn wait_until(&self, time: Instant) {
        tokio::time::sleep_until(time).await;
    }
}

/// A line with a limited number of bytes per second. A request books its bytes and starts when all
/// bytes booked before have been transferred. A limit inside a request would trigger its timeout.
#[derive(Debug)]
struct Line {
    bytes_per_s: f64,
    free: Mutex<Option<Instant>>,
    clock: Arc<dyn Clock>,
}

impl Line {
    /// Returns the time at which a transfer of these bytes may start.
    fn book(&self, bytes: u64) -> Instant {
        let mut free = self.free.lock().expect("nothing panics while it is held");
        let now = self.clock.now();
        let start = free.map_or(now, |free| free.max(now));
        *free = Some(start + Duration::from_secs_f64(bytes as f64 / self.bytes_per_s));
        start
    }

    async fn carry(&self, bytes: u64) {
        let start = self.book(bytes);
        self.clock.wait_until(start).await;
    }
}

async fn carry(line: &Option<Arc<Line>>, bytes: u64) {
    if let Some(line) = line {
        line.carry(bytes).await;
    }
}

/// A store with bandwidth limits.
#[derive(Debug)]
pub(super) struct Limited<T> {
    inner: T,
    limits: Limits,
}

impl<T> Limited<T> {
    pub(super) fn new(inner: T, limits: Limits) -> Self {
        Self { inner, limits }
    }
}

impl<T: ObjectStore> std::fmt::Display for Limited<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.inner)
    }
}

#[async_trait::async_trait]
impl<T: ObjectStore> ObjectStore for Limited<T> {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        carry(&self.limits.upload, payload.content_length() as u64).await;
        self.inner.put_opts(location, payload, options).await
    }

    // Multipart uploads are not used.
    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, options).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        let known = match &options.range {
            _ if options.head => Some(0),
            Some(GetRange::Bounded(range)) => Some(range.end.saturating_sub(range.start)),
            Some(GetRange::Suffix(bytes)) => Some(*bytes),
            Some(GetRange::Offset(_)) | None => None,
        };
        // The size of a whole object is known only when the answer arrives, so it starts at once
        // and the next request waits for it.
        carry(&self.limits.download, known.unwrap_or(0)).await;
        let result = self.inner.get_opts(location, options).await?;
        if let (None, Some(line), GetResultPayload::Stream(_)) =
            (known, &self.limits.download, &result.payload)
        {
            line.book(result.range.end - result.range.start);
        }
        Ok(result)
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        let bytes = ranges.iter().map(|r| r.end.saturating_sub(r.start)).sum();
        carry(&self.limits.download, bytes).await;
        self.inner.get_ranges(location, ranges).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(locations).boxed()
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    fn list_with_offset(
        &self,
        prefix: Option<&Path>,
        offset: &Path,
    ) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list_with_offset(prefix, offset)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.inner.rename_opts(from, to, options).await
    }
}

#[cfg(test)]
mod tests {
    use futures::future::join_all;
    use object_store::ObjectStoreExt;
    use object_store::memory::InMemory;

    use super::*;

    const MB: usize = 1_000_000;

    /// A simulated clock. Its time is the latest time that anyone has waited for.
    #[derive(Debug)]
    struct Simulated {
        start: Instant,
        now: Mutex<Instant>,
    }

    impl Simulated {
        fn seconds(&self) -> f64 {
            self.now().duration_since(self.start).as_secs_f64()
        }
    }

    #[async_trait::async_trait]
    impl Clock for Simulated {
        fn now(&self) -> Instant {
            *self.now.lock().unwrap()
        }

        async fn wait_until(&self, time: Instant) {
            let mut now = self.now.lock().unwrap();
            *now = time.max(*now);
        }
    }

    fn store(upload: Option<f64>, download: Option<f64>) -> (Limited<InMemory>, Arc<Simulated>) {
        let start = Instant::now();
        let clock = Arc::new(Simulated {
            start,
            now: Mutex::new(start),
        });
        let limits = Limits::new(Bandwidth { upload, download }, &(clock.clone() as _));
        (Limited::new(InMemory::new(), limits), clock)
    }

    fn key(i: usize) -> Path {
        Path::from(format!("a/{i}"))
    }

    #[tokio::test]
    async fn puts_at_once_start_one_after_another_at_the_rate_set() {
        let (store, clock) = store(Some(10e6), None);
        let body = Bytes::from(vec![0; 20 * MB]);
        let keys: Vec<Path> = (0..5).map(key).collect();
        let puts = keys.iter().map(|key| store.put(key, body.clone().into()));
        assert!(join_all(puts).await.iter().all(Result::is_ok));
        assert_eq!(
            clock.seconds(),
            8.0,
            "the fifth starts when four are through"
        );
        clock
            .wait_until(clock.now() + Duration::from_secs(100))
            .await;
        store.put(&key(9), vec![0; MB].into()).await.unwrap();
        assert_eq!(clock.seconds(), 108.0, "a line that was free is free");
        store.put(&key(9), vec![0; MB].into()).await.unwrap();
        assert_eq!(
            clock.seconds(),
            108.1,
            "time that nobody used is not saved up"
        );
        for key in &keys {
            store.get(key).await.unwrap().bytes().await.unwrap();
        }
        assert_eq!(clock.seconds(), 108.1, "the other way has no limit");
    }

    #[tokio::test]
    async fn gets_of_every_kind_count_the_bytes_that_come() {
        let (store, clock) = store(None, Some(1e6));
        store.put(&key(0), vec![7; 4 * MB].into()).await.unwrap();
        for _ in 0..3 {
            let found = store
                .get_ranges(&key(0), &[0..500_000, 2_000_000..2_500_000])
                .await;
            assert_eq!(found.unwrap().len(), 2);
        }
        store.get_range(&key(0), 0..1_000_000).await.unwrap();
        assert_eq!(clock.seconds(), 3.0);
        // A megabyte is still in transit, then four of the whole object, so the head request waits
        // for both.
        store.get(&key(0)).await.unwrap().bytes().await.unwrap();
        assert_eq!(clock.seconds(), 4.0);
        store.head(&key(0)).await.unwrap();
        assert_eq!(clock.seconds(), 8.0);
    }
}
