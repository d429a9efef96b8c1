//! Tests of repeated requests against a server that breaks off.

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
