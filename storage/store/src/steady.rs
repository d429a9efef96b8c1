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
mod tests;
