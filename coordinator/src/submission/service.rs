//! What submissions share: the catalog, the stores, and the way to the actor.

use std::sync::Arc;

use picofarm_catalog::{Catalog, CatalogError, Job, Specs, StageRecord};
use picofarm_proto::{ids::JobId, messages::JobState};
use tokio::sync::{Mutex, mpsc};

use super::{
    draft::Draft, evidence::Evidence, result_reader::ResultReader, store_checks::StoreChecks,
};
use crate::{
    actor::{Command, Lanes, Refusal},
    auth::Visibility,
    core::{Clock, NewJob, Timings},
    memory::{Charge, Memory, kept_cost},
};

/// Plans and submits jobs.
#[derive(Clone)]
pub(crate) struct Submissions {
    pub(super) catalog: Arc<dyn Catalog>,
    pub(super) lanes: Lanes,
    pub(super) stores: StoreChecks,
    pub(super) commands: mpsc::Sender<Command>,
    pub(super) clock: Clock,
    /// Which jobs of others a caller can see.
    pub(super) visibility: Visibility,
    pub(super) memory: Arc<Memory>,
    /// Evidence of whether the stores here are those of the workers.
    pub(super) evidence: Arc<Evidence>,
    /// Locked while a job is counted against its user's quota and recorded.
    pub(super) turn: Arc<Mutex<()>>,
}

impl Submissions {
    pub(crate) fn new(
        catalog: Arc<dyn Catalog>,
        lanes: Lanes,
        stored: Option<Arc<dyn ResultReader>>,
        commands: mpsc::Sender<Command>,
        clock: Clock,
        visibility: Visibility,
        memory: Arc<Memory>,
    ) -> Self {
        Self {
            catalog,
            lanes,
            stores: StoreChecks::new(stored),
            commands,
            clock,
            visibility,
            memory,
            evidence: Arc::default(),
            turn: Arc::default(),
        }
    }

    /// Charges the memory for these specs until the value is dropped.
    pub(super) async fn charge(
        &self,
        draft: &Draft,
        specs: Specs<'_>,
    ) -> Result<Option<Charge>, Refusal> {
        let bytes = self.catalog.spec_bytes(specs).await.map_err(broken)?;
        draft.charge(bytes).await.map_err(Refusal::TooMany)
    }

    /// Sends a recorded job to the actor and waits until the actor has added it.
    pub(super) async fn announce(&self, job: Job, stages: Vec<StageRecord>) -> Result<(), Refusal> {
        let mut timings = Timings::new();
        for stage in &stages {
            let timing = self.catalog.timing(&stage.set).await.map_err(broken)?;
            timings.insert(stage.set.clone(), timing);
        }
        // A job without any task to run has already ended.
        let state = self.catalog.state(job.id).await.map_err(broken)?;
        let new_job = NewJob {
            kept: kept_cost(&job.spec),
            job,
            stages,
            timings,
        };
        let new_job = (state == Some(JobState::Active)).then_some(new_job);
        let (reply, answer) = tokio::sync::oneshot::channel();
        let command = Command::Learn(new_job.map(Box::new), reply);
        if self.commands.send(command).await.is_ok() {
            // If the actor is between two lives, it finds the job in the catalog.
            let _ = answer.await;
        }
        Ok(())
    }

    /// Sends the actor a job that it does not know yet, if the job is active.
    pub(crate) async fn learn(&self, id: JobId) -> Result<(), Refusal> {
        let it = self.clone();
        self.lanes
            .read(move || async move {
                match it.catalog.job(id).await.map_err(broken)? {
                    Some(record) => {
                        let stages = record.job.stages();
                        it.announce(record.job, stages).await
                    }
                    None => Ok(()),
                }
            })
            .await
    }

    /// Returns the refusal after a failed catalog write. The actor is notified unless the content
    /// is at fault.
    pub(super) async fn unwritable(&self, error: CatalogError) -> Refusal {
        if matches!(error, CatalogError::Refused { .. }) {
            return broken(error);
        }
        let why = Refusal::Catalog(error.to_string());
        // If the actor is gone, it already knows.
        let _ = self.commands.send(Command::Broken(error)).await;
        why
    }

    /// Runs slow work on a draft on a separate thread.
    pub(super) async fn heavy<T, F>(
        &self,
        draft: &Arc<Draft>,
        work: impl FnOnce(Self, Arc<Draft>) -> F + Send + 'static,
    ) -> T
    where
        T: Send + 'static,
        F: Future<Output = T>,
    {
        let (it, draft) = (self.clone(), Arc::clone(draft));
        self.lanes.heavy(draft.bytes, move || work(it, draft)).await
    }
}

pub(super) fn broken(error: CatalogError) -> Refusal {
    match error {
        CatalogError::Refused { what, .. } => Refusal::Content(what),
        error => Refusal::Catalog(error.to_string()),
    }
}
