//! An in-memory store that loses answers, repeats requests, and lets others act at the worst
//! moment.

use std::fmt;
use std::sync::{Arc, Mutex};

use futures::StreamExt;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::*;

/// The outcome of a create-only put.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// It is executed and answered.
    Good,
    /// It is executed, but the answer is lost.
    Lost,
    /// It never arrives.
    Dropped,
    /// It is executed, its answer is lost, and the client itself repeats it.
    Repeated,
}

/// A moment at which others may act.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    BeforePut,
    BeforeDelete,
    AfterDelete,
}

type Decide = Box<dyn FnMut(&Path) -> Fate + Send>;
type Act = Box<dyn Fn(Moment, Path) -> BoxFuture<'static, ()> + Send + Sync>;

/// The store. Gets, lists and other requests are passed to the memory store.
pub struct Tricky {
    pub memory: Arc<InMemory>,
    /// The reads so far: object, first byte and end.
    pub got: Mutex<Vec<(Path, u64, u64)>>,
    decide: Mutex<Decide>,
    act: Arc<Act>,
}

impl Tricky {
    pub fn new(memory: Arc<InMemory>) -> Self {
        Self {
            memory,
            got: Mutex::default(),
            decide: Mutex::new(Box::new(|_| Fate::Good)),
            act: Arc::new(Box::new(|_, _| Box::pin(async {}))),
        }
    }

    pub fn deciding(self, decide: impl FnMut(&Path) -> Fate + Send + 'static) -> Self {
        Self {
            decide: Mutex::new(Box::new(decide)),
            ..self
        }
    }

    pub fn acting(
        self,
        act: impl Fn(Moment, Path) -> BoxFuture<'static, ()> + Send + Sync + 'static,
    ) -> Self {
        Self {
            act: Arc::new(Box::new(act)),
            ..self
        }
    }
}

fn timed_out() -> Error {
    Error::Generic {
        store: "tricky",
        source: "the request timed out".into(),
    }
}

impl fmt::Display for Tricky {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tricky")
    }
}

impl fmt::Debug for Tricky {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tricky")
    }
}

#[async_trait::async_trait]
impl ObjectStore for Tricky {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        (self.act)(Moment::BeforePut, location.clone()).await;
        let fate = (self.decide.lock().unwrap())(location);
        let put = || {
            self.memory
                .put_opts(location, payload.clone(), options.clone())
        };
        match fate {
            Fate::Good => put().await,
            Fate::Dropped => Err(timed_out()),
            Fate::Lost => put().await.and(Err(timed_out())),
            Fate::Repeated => {
                put().await?;
                put().await
            }
        }
    }
    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.memory.put_multipart_opts(location, options).await
    }
    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        let result = self.memory.get_opts(location, options).await?;
        let got = (location.clone(), result.range.start, result.range.end);
        self.got.lock().unwrap().push(got);
        Ok(result)
    }
    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let (memory, act) = (self.memory.clone(), self.act.clone());
        locations
            .then(move |location| {
                let (memory, act) = (memory.clone(), act.clone());
                async move {
                    let location = location?;
                    act(Moment::BeforeDelete, location.clone()).await;
                    memory.delete(&location).await?;
                    act(Moment::AfterDelete, location.clone()).await;
                    Ok(location)
                }
            })
            .boxed()
    }
    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.memory.list(prefix)
    }
    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.memory.list_with_delimiter(prefix).await
    }
    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.memory.copy_opts(from, to, options).await
    }
}
