//! A spec that was read and checked, with what follows from it and takes long to find out: once.

use std::sync::Arc;

use picofarm_catalog::{Job, StageRecord};
use picofarm_proto::{
    ids::JobId,
    key::spec_hash,
    model::{JobSpec, JobState},
};
use sha2::{Digest, Sha256};
use uuid::Uuid;

use crate::memory::{Account, Charge, kept_cost, stored_cost};

/// A job that may be submitted.
#[derive(Debug, Clone)]
pub(crate) struct Draft {
    pub spec: Arc<JobSpec>,
    /// SHA-256 of the spec, hexadecimal.
    pub hash: String,
    /// Its stages, whose job has no id yet.
    stages: Vec<StageRecord>,
    /// Size of the spec as it was sent.
    pub bytes: usize,
    /// Memory that the job takes until it ends.
    pub kept: u64,
    /// Who pays for its memory, until it is dropped.
    charged: Option<Arc<(Account, Charge)>>,
}

impl Draft {
    /// Hashes the spec: seconds for one of some ten megabytes.
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

    /// The same, whose memory is on this account.
    pub(crate) fn charged(mut self, charged: (Account, Charge)) -> Self {
        self.charged = Some(Arc::new(charged));
        self
    }

    /// Takes memory for specs of this length together that are read because of it.
    ///
    /// # Errors
    /// There is none, in words.
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

    /// What tells whether two submissions are the same job: the whole spec, and among whose jobs an equal one is looked for
    /// (empty = among all).
    pub(crate) fn identity(&self, circle: &str) -> String {
        match circle {
            "" => self.hash.clone(),
            _ => hex::encode(Sha256::digest(format!("{} {circle}", self.hash))),
        }
    }

    /// Its stages.
    pub(crate) fn stages(&self) -> &[StageRecord] {
        &self.stages
    }

    /// The job that it becomes, and that job's stages.
    /// An equal job is looked for in `circle`.
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
