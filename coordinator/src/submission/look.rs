//! Asking stores, for a bounded time and few at a time: a store that hangs holds up whoever asked about it, once.

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, Mutex},
    time::Duration,
};

use picofarm_catalog::Recorded;
use picofarm_proto::model::StageSpec;
use tokio::{
    sync::Semaphore,
    time::{Instant, timeout_at},
};

use crate::stored::{Found, Stored};

/// How long a plan or submission waits for stores.
const PATIENCE: Duration = Duration::from_secs(20);
/// How long a worker's report waits for its store.
const REPORT_PATIENCE: Duration = Duration::from_secs(5);
/// How long a store that did not answer is not asked again.
const SILENT: Duration = Duration::from_secs(60);
/// Who may ask one store at a time, and all of them.
const EACH: usize = 4;
const TOGETHER: usize = 32;
/// Results in one question.
const BATCH: usize = 64;
/// Stores remembered at most.
const STORES: usize = 1_024;

/// The stores of this coordinator, as far as it may look into them.
#[derive(Debug, Clone)]
pub(crate) struct Stores {
    reader: Option<Arc<dyn Stored>>,
    all: Arc<Semaphore>,
    each: Arc<Mutex<HashMap<String, Store>>>,
}

#[derive(Debug, Clone)]
struct Store {
    lane: Arc<Semaphore>,
    silent_until: Option<Instant>,
}

/// When a report waits no longer for its store, and is committed as unverified.
pub(crate) fn soon() -> Instant {
    Instant::now() + REPORT_PATIENCE
}

/// When a plan waits no longer for stores.
pub(crate) fn deadline() -> Instant {
    Instant::now() + PATIENCE
}

impl Stores {
    pub(crate) fn new(reader: Option<Arc<dyn Stored>>) -> Self {
        Self {
            reader,
            all: Arc::new(Semaphore::new(TOGETHER)),
            each: Arc::default(),
        }
    }

    /// Whether any store can be asked.
    pub(crate) fn any(&self) -> bool {
        self.reader.is_some()
    }

    /// Asks about recorded outputs of a stage; gives the answers by task, and why there are not more.
    pub(crate) async fn look(
        &self,
        stage: &StageSpec,
        place: &str,
        outputs: &[Recorded],
        until: Instant,
    ) -> (BTreeMap<u64, Found>, Option<String>) {
        let mut found = BTreeMap::new();
        if outputs.is_empty() {
            return (found, None);
        }
        let Some(reader) = &self.reader else {
            return (found, Some(UNTOLD.into()));
        };
        let store = self.store(place);
        if store.silent_until.is_some_and(|at| Instant::now() < at) {
            let why = "the store did not answer a moment ago";
            return (found, Some(why.into()));
        }
        let asked = async {
            let _all = self.all.acquire().await.expect("never closed");
            let _mine = store.lane.acquire().await.expect("never closed");
            for batch in outputs.chunks(BATCH) {
                let questions: Vec<_> = batch.iter().map(|o| (o.task, o.manifest)).collect();
                let answers = reader.look(stage, &questions).await?;
                found.extend(batch.iter().map(|o| o.task).zip(answers));
            }
            Ok(())
        };
        let why = match timeout_at(until, asked).await {
            Ok(Ok(())) => None,
            Ok(Err(why)) => Some(why),
            Err(_) if found.is_empty() => {
                self.silent(place);
                let seconds = PATIENCE.as_secs();
                Some(format!("the store did not answer within {seconds} s"))
            }
            Err(_) => Some(format!(
                "there was time for {} of {} of them",
                found.len(),
                outputs.len()
            )),
        };
        (found, why)
    }

    fn store(&self, name: &str) -> Store {
        let mut each = self.each.lock().expect("no panic while locked");
        if each.len() > STORES {
            each.clear();
        }
        let new = || Store {
            lane: Arc::new(Semaphore::new(EACH)),
            silent_until: None,
        };
        each.entry(name.to_owned()).or_insert_with(new).clone()
    }

    fn silent(&self, name: &str) {
        let mut each = self.each.lock().expect("no panic while locked");
        if let Some(store) = each.get_mut(name) {
            store.silent_until = Some(Instant::now() + SILENT);
        }
    }
}

/// Why a coordinator that was given nothing to look with does not look.
const UNTOLD: &str = "this coordinator looks into no stores (--check-stores none)";
