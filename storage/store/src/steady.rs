//! A wrapper for unreliable network stores: interrupted or temporarily refused requests and
//! truncated answers are repeated, and corrupted objects are put again.

use std::fmt;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::stream::{self, BoxStream};
use futures::{StreamExt, TryStreamExt};
use md5::{Digest, Md5};
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, GetResultPayload, ListResult, MultipartUpload,
    ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutMultipartOptions, PutOptions, PutPayload,
    PutResult, RenameOptions, Result,
};

use super::failure;

/// Pauses before a request is repeated, in milliseconds.
const PAUSES_MS: [u64; 6] = [50, 100, 200, 400, 800, 1600];
/// A request that has taken this long is not repeated; the caller decides.
const REPEAT_WITHIN: Duration = Duration::from_secs(20);
/// Number of concurrent deletions.
const DELETIONS: usize = 8;

/// A store with repeated requests.
#[derive(Debug)]
pub(super) struct Steady<T> {
    store: Arc<T>,
    pauses_ms: [u64; PAUSES_MS.len()],
}

impl<T> Clone for Steady<T> {
    fn clone(&self) -> Self {
        Self {
            store: self.store.clone(),
            pauses_ms: self.pauses_ms,
        }
    }
}

impl<T: ObjectStore> Steady<T> {
    pub(super) fn new(store: T) -> Self {
        Self {
            store: Arc::new(store),
            pauses_ms: PAUSES_MS,
        }
    }

    /// Repeats a request while it fails temporarily. The request gets the number of repetitions so
    /// far.
    async fn repeat<R, F: Future<Output = Result<R>>>(
        &self,
        request: impl Fn(usize) -> F,
    ) -> Result<R> {
        let begun = Instant::now();
        let mut pauses = self.pauses_ms.iter().enumerate();
        loop {
            let (times, pause) = pauses
                .next()
                .map_or((PAUSES_MS.len(), None), |(k, p)| (k, Some(p)));
            let error = match request(times).await {
                Ok(answer) => return Ok(answer),
                Err(error) => error,
            };
            let over = begun.elapsed() >= REPEAT_WITHIN;
            let Some(pause) = pause.filter(|_| !over && passes(&error)) else {
                return Err(error);
            };
            tracing::debug!(%error, pause, "a request to the store is repeated");
            tokio::time::sleep(Duration::from_millis(*pause)).await;
        }
    }

    /// Puts an object once. The answer to an earlier attempt may have been lost.
    async fn put_once(
        &self,
        location: &Path,
        (payload, bytes): (PutPayload, &Bytes),
        options: PutOptions,
        repeated: bool,
    ) -> Result<PutResult> {
        let create = matches!(options.mode, PutMode::Create);
        let put = match self.store.put_opts(location, payload, options).await {
            Err(e @ (Error::AlreadyExists { .. } | Error::Precondition { .. }))
                if create && repeated =>
            {
                let found = self.get_opts(location, GetOptions::default()).await?;
                let found = found.bytes().await?;
                return match found == *bytes {
                    // The earlier attempt was executed.
                    true => Ok(PutResult {
                        e_tag: None,
                        version: None,
                        extensions: Default::default(),
                    }),
                    false => Err(e),
                };
            }
            other => other?,
        };
        Ok(put)
    }

    /// Returns whether a put arrived uncorrupted. If the service's tag does not look like an MD5 of
    /// the content, only the size is compared.
    async fn arrived(&self, location: &Path, bytes: &Bytes, put: &PutResult) -> Result<bool> {
        if put.e_tag.as_deref().and_then(md5_of) == Some(Md5::digest(bytes).into()) {
            return Ok(true);
        }
        let meta = self.repeat(|_| self.store.head(location)).await?;
        if meta.size != bytes.len() as u64 {
            return Ok(false);
        }
        if put.e_tag.as_deref().and_then(md5_of).is_none() {
            return Ok(true);
        }
        // For an encrypted object, the tag looks like an MD5 but is not one.
        let found = self.get_opts(location, GetOptions::default()).await?;
        Ok(found.bytes().await? == *bytes)
    }
}

/// Returns the MD5 in an entity tag.
fn md5_of(tag: &str) -> Option<[u8; 16]> {
    let mut md5 = [0; 16];
    hex::decode_to_slice(tag.trim_matches('"'), &mut md5).ok()?;
    Some(md5)
}

/// Returns whether an error may be temporary: an interrupted connection, or a refusal, because
/// services refuse for a moment while keys are renewed. Requests with server errors were already
/// repeated.
fn passes(error: &Error) -> bool {
    match error {
        Error::Unauthenticated { .. } | Error::PermissionDenied { .. } => true,
        Error::Generic { .. } => failure::breaks_off(error),
        _ => false,
    }
}

fn wrong(location: &Path, what: &str) -> Error {
    Error::Generic {
        store: "checked store",
        source: Box::new(Broken(format!("{location}: {what}"))),
    }
}

/// An answer that cannot be correct.
#[derive(Debug)]
pub(super) struct Broken(String);

impl fmt::Display for Broken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Broken {}

impl<T: ObjectStore> fmt::Display for Steady<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.store)
    }
}

#[async_trait::async_trait]
impl<T: ObjectStore> ObjectStore for Steady<T> {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        let bytes: Bytes = payload.clone().into();
        let put = |options: PutOptions| {
            let (payload, bytes) = (&payload, &bytes);
            self.repeat(move |times| {
                let sent = (payload.clone(), bytes);
                self.put_once(location, sent, options.clone(), times > 0)
            })
        };
        let mut done = put(options.clone()).await?;
        let mut tries = 0;
        while !self.arrived(location, &bytes, &done).await? {
            tries += 1;
            if tries > PAUSES_MS.len() {
                let what = "it was put again and again, and the store never has what was sent";
                return Err(wrong(location, what));
            }
            tracing::warn!(object = %location, "the store has other bytes than were sent; they are put again");
            // The object belongs to this writer, because its create-only put succeeded.
            let again = PutOptions {
                mode: PutMode::Overwrite,
                ..options.clone()
            };
            done = put(again).await?;
        }
        Ok(done)
    }

    // Multipart uploads are not used.
    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.store.put_multipart_opts(location, options).await
    }

    /// The answer has its whole body: a truncated one is requested again, too.
    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.repeat(async |_| {
            let found = self.store.get_opts(location, options.clone()).await?;
            if options.head || !matches!(found.payload, GetResultPayload::Stream(_)) {
                return Ok(found);
            }
            let (meta, range) = (found.meta.clone(), found.range.clone());
            let (attributes, extensions) = (found.attributes.clone(), found.extensions.clone());
            let bytes = found.bytes().await?;
            if bytes.len() as u64 != range.end - range.start {
                return Err(wrong(location, "the answer is shorter than it announces"));
            }
            Ok(GetResult {
                payload: GetResultPayload::Stream(stream::once(async { Ok(bytes) }).boxed()),
                meta,
                range,
                attributes,
                extensions,
            })
        })
        .await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let this = self.clone();
        locations
            .map(move |location| {
                let this = this.clone();
                async move {
                    let location = location?;
                    this.repeat(|_| this.store.delete(&location)).await?;
                    Ok(location)
                }
            })
            .buffered(DELETIONS)
            .boxed()
    }

    /// Repeats the request if the first answer does not arrive; the store itself repeats the
    /// requests of later pages.
    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let (this, prefix) = (self.clone(), prefix.cloned());
        let list = async move {
            this.repeat(async |_| {
                let mut list = this.store.list(prefix.as_ref());
                let first = list.next().await.transpose()?;
                Ok(stream::iter(first.map(Ok)).chain(list))
            })
            .await
        };
        stream::once(list).try_flatten().boxed()
    }

    fn list_with_offset(
        &self,
        prefix: Option<&Path>,
        offset: &Path,
    ) -> BoxStream<'static, Result<ObjectMeta>> {
        self.store.list_with_offset(prefix, offset)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.repeat(|_| self.store.list_with_delimiter(prefix))
            .await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.store.copy_opts(from, to, options).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.store.rename_opts(from, to, options).await
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::sync::Mutex;

    use object_store::memory::InMemory;

    use super::*;
    use crate::probe;

    /// A fault of a request.
    #[derive(Debug, Clone, Copy, PartialEq)]
    enum Fault {
        None,
        /// The request is executed, and refused.
        Forbidden,
        /// A byte of a put is changed, and an answer's body is truncated.
        Bytes,
    }

    /// Injects the faults of a list, repeatedly.
    #[derive(Debug)]
    struct Faulty {
        store: InMemory,
        faults: Mutex<VecDeque<Fault>>,
    }

    impl Faulty {
        fn next(&self) -> Fault {
            let mut faults = self.faults.lock().unwrap();
            let next = faults.pop_front().unwrap();
            faults.push_back(next);
            next
        }
    }

    fn forbidden() -> Error {
        Error::PermissionDenied {
            path: "x".into(),
            source: "403".into(),
        }
    }

    impl fmt::Display for Faulty {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("AmazonS3(lab)")
        }
    }

    #[async_trait::async_trait]
    impl ObjectStore for Faulty {
        async fn put_opts(
            &self,
            location: &Path,
            payload: PutPayload,
            options: PutOptions,
        ) -> Result<PutResult> {
            let fault = self.next();
            let mut bytes: Vec<u8> = Bytes::from(payload).into();
            if fault == Fault::Bytes {
                bytes[0] ^= 1;
            }
            let tag = hex::encode(Md5::digest(&bytes));
            let put = self.store.put_opts(location, bytes.into(), options).await?;
            match fault {
                Fault::Forbidden => Err(forbidden()),
                _ => Ok(PutResult {
                    e_tag: Some(format!("\"{tag}\"")),
                    ..put
                }),
            }
        }

        async fn put_multipart_opts(
            &self,
            location: &Path,
            options: PutMultipartOptions,
        ) -> Result<Box<dyn MultipartUpload>> {
            self.store.put_multipart_opts(location, options).await
        }

        async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
            let mut found = self.store.get_opts(location, options.clone()).await?;
            match self.next() {
                Fault::Forbidden => return Err(forbidden()),
                Fault::Bytes if !options.head => {
                    let short = stream::once(async { Ok(Bytes::from_static(b"x")) });
                    found.payload = GetResultPayload::Stream(short.boxed());
                }
                _ => {}
            }
            Ok(found)
        }

        fn delete_stream(
            &self,
            locations: BoxStream<'static, Result<Path>>,
        ) -> BoxStream<'static, Result<Path>> {
            self.store.delete_stream(locations)
        }

        fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
            match self.next() {
                Fault::None => self.store.list(prefix),
                _ => stream::once(async { Err(forbidden()) }).boxed(),
            }
        }

        async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
            self.store.list_with_delimiter(prefix).await
        }

        async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
            self.store.copy_opts(from, to, options).await
        }
    }

    fn store(faults: &[Fault]) -> Steady<Faulty> {
        Steady {
            pauses_ms: [0; PAUSES_MS.len()],
            ..Steady::new(Faulty {
                store: InMemory::new(),
                faults: Mutex::new(faults.iter().copied().collect()),
            })
        }
    }

    #[tokio::test]
    async fn a_store_that_refuses_flips_and_shortens_does_what_is_asked_in_the_end() {
        let (none, no, bytes) = (Fault::None, Fault::Forbidden, Fault::Bytes);
        for faults in [
            &[no, none][..],
            &[bytes, none, none, none, none],
            &[no, bytes, none, none, none],
        ] {
            let store = store(faults);
            for k in 0..20 {
                let (path, body) = (Path::from(format!("a/{k}")), format!("{k} is the body"));
                let create = PutOptions::from(PutMode::Create);
                let body = Bytes::from(body);
                store
                    .put_opts(&path, body.clone().into(), create.clone())
                    .await
                    .unwrap();
                assert_eq!(
                    store
                        .store
                        .store
                        .get(&path)
                        .await
                        .unwrap()
                        .bytes()
                        .await
                        .unwrap(),
                    body
                );
                assert_eq!(store.get(&path).await.unwrap().bytes().await.unwrap(), body);
                let second = store.put_opts(&path, "another".into(), create).await;
                assert!(matches!(second, Err(Error::AlreadyExists { .. })));
            }
            let listed: Vec<_> = store.list(None).try_collect().await.unwrap();
            assert_eq!(listed.len(), 20);
        }
        // The guarantee of create-only puts can be verified although answers are lost.
        probe(
            &store(&[no, none, none]),
            &Path::from("p"),
            Duration::from_secs(30),
        )
        .await
        .unwrap();
    }

    #[tokio::test]
    async fn a_store_that_never_plays_along_fails_with_its_own_words() {
        let path = Path::from("a");
        let error = store(&[Fault::Forbidden]).put(&path, "x".into()).await;
        assert!(matches!(error, Err(Error::PermissionDenied { .. })));
        let error = store(&[Fault::Bytes]).put(&path, "body".into()).await;
        assert!(
            error
                .unwrap_err()
                .to_string()
                .contains("shorter than it announces")
        );
    }
}
