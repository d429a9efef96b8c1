//! A spec that was read and checked once, with the derived values that are slow to compute.

use std::sync::Arc;

use picofarm_catalog::{Job, StageRecord};
use picofarm_proto::{ids::JobId, key::spec_hash, messages::JobState, spec::JobSpec};
use sha2::{Digest, Sha256};
use uuid::Uuid;

use crate::memory::{Account, Charge, kept_cost, stored_cost};

/// A job that may be submitted.
#[derive(Debug, Clone)]
pub(crate) struct Draft {
    pub spec: Arc<JobSpec>,
    /// SHA-256 of the spec, hexadecimal.
    pub hash: String,
    /// The job's stages, which have no job id yet.
    stages: Vec<StageRecord>,
    /// Size of the spec as it was sent, bytes.
    pub bytes: usize,
    /// Memory that the job uses until it ends, bytes.
    pub kept: u64,
    /// The account charged for the draft's memory, until the draft is dropped.
    charged: Option<Arc<(Account, Charge)>>,
}

impl Draft {
    /// Hashes the spec, which takes seconds for a spec of tens of megabytes.
    pub(crate) fn new(spec: JobSpec, bytes: usize) -> Self {
        let hash = spec_hash(&spec);
        let spec = Arc::new(spec);
        let job = Job {
            id: JobId::from_uuid(Uuid::nil()),
            spec_hash: hash.clone(),
            spec: Arc::clone(&spec),
            state: JobState::Active,
            submitted_ms: 0,
            ended_ms: None,
            paused: false,
            user: String::new(),
        };
        Self {
            kept: kept_cost(&spec),
            spec,
            hash,
            stages: job.stages(),
            bytes,
            charged: None,
        }
    }

    /// Returns the draft with its memory charged to this account.
    pub(crate) fn charged(mut self, charged: (Account, Charge)) -> Self {
        self.charged = Some(Arc::new(charged));
        self
    }

    /// Charges the memory for specs of this total length that are read because of the draft.
    ///
    /// # Errors
    /// Returns the reason if the memory is not available.
    pub(crate) async fn charge(&self, bytes: u64) -> Result<Option<Charge>, String> {
        let Some(charged) = &self.charged else {
            return Ok(None);
        };
        let what = "reading the specs that this job is compared with";
        match charged.0.charge(what, stored_cost(bytes)).await {
            Ok(charge) => Ok(Some(charge)),
            Err(refused) => Err(refused.message().to_owned()),
        }
    }

    /// Returns the identity of a submission: the hash of the whole spec, and the circle of jobs
    /// among which an equal one is looked up. An empty circle means all jobs.
    pub(crate) fn identity(&self, circle: &str) -> String {
        match circle {
            "" => self.hash.clone(),
            _ => hex::encode(Sha256::digest(format!("{} {circle}", self.hash))),
        }
    }

    /// Returns the job's stages.
    pub(crate) fn stages(&self) -> &[StageRecord] {
        &self.stages
    }

    /// Returns the job to be recorded and its stages. An equal job is looked up in `circle`.
    pub(crate) fn job(
        &self,
        id: JobId,
        user: String,
        circle: &str,
        now_ms: i64,
    ) -> (Job, Vec<StageRecord>) {
        let job = Job {
            id,
            spec_hash: self.identity(circle),
            spec: Arc::clone(&self.spec),
            state: JobState::Active,
            submitted_ms: now_ms,
            ended_ms: None,
            paused: false,
            user,
        };
        let mut stages = self.stages.clone();
        for stage in &mut stages {
            stage.id.job = id;
        }
        (job, stages)
    }
}
