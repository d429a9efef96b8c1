//! Checks stores in bounded time and with bounded concurrency. A store that hangs delays each
//! caller only once.

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, Mutex},
    time::Duration,
};

use picofarm_catalog::Recorded;
use picofarm_proto::spec::StageSpec;
use tokio::{
    sync::Semaphore,
    time::{Instant, timeout_at},
};

use super::result_reader::{ResultReader, ResultState};

/// Longest time that a plan or submission waits for stores.
const PATIENCE: Duration = Duration::from_secs(20);
/// Longest time that a worker's report waits for its store.
const REPORT_PATIENCE: Duration = Duration::from_secs(5);
/// Time after which a store that did not answer is tried again.
const SILENT: Duration = Duration::from_secs(60);
/// Most concurrent checks of one store, and of all stores.
const EACH: usize = 4;
const TOGETHER: usize = 32;
/// Results in one query.
const BATCH: usize = 64;
/// Most stores remembered.
const STORES: usize = 1_024;

/// The stores that this coordinator may read.
#[derive(Debug, Clone)]
pub(crate) struct StoreChecks {
    reader: Option<Arc<dyn ResultReader>>,
    all: Arc<Semaphore>,
    each: Arc<Mutex<HashMap<String, Store>>>,
}

#[derive(Debug, Clone)]
struct Store {
    lane: Arc<Semaphore>,
    silent_until: Option<Instant>,
}

/// Returns the time at which a report stops waiting for its store and is committed as unverified.
pub(crate) fn report_deadline() -> Instant {
    Instant::now() + REPORT_PATIENCE
}

/// Returns the time at which a plan stops waiting for stores.
pub(crate) fn plan_deadline() -> Instant {
    Instant::now() + PATIENCE
}

impl StoreChecks {
    pub(crate) fn new(reader: Option<Arc<dyn ResultReader>>) -> Self {
        Self {
            reader,
            all: Arc::new(Semaphore::new(TOGETHER)),
            each: Arc::default(),
        }
    }

    /// Returns whether any store can be checked.
    pub(crate) fn any(&self) -> bool {
        self.reader.is_some()
    }

    /// Checks recorded outputs of a stage. Returns the answers by task, and the reason if some are
    /// missing.
    pub(crate) async fn check(
        &self,
        stage: &StageSpec,
        place: &str,
        outputs: &[Recorded],
        until: Instant,
    ) -> (BTreeMap<u64, ResultState>, Option<String>) {
        let mut found = BTreeMap::new();
        if outputs.is_empty() {
            return (found, None);
        }
        let Some(reader) = &self.reader else {
            return (found, Some(NO_READER.into()));
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
                let answers = reader.check(stage, &questions).await?;
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

/// Reason given by a coordinator without access to any store.
const NO_READER: &str = "this coordinator looks into no stores (--check-stores none)";
