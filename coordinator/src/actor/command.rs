//! Requests to the actor, and its answers.

use std::{collections::BTreeMap, sync::Arc};

use picofarm_catalog::CatalogError;
use picofarm_proto::{
    ids::{JobId, LeaseRef},
    messages::{Examine, Failure, Finished, JobPlan, TaskLog, TaskProgress, WorkerHello},
    spec::{JobSpec, SpecError},
};
use tokio::sync::{mpsc, oneshot};

use super::sessions::HeartbeatQueue;
use crate::core::{
    Asked, Demand, EligibleWorkers, FarmSnapshot, JobSnapshot, NewJob, Overlay, Reported,
    SessionId, Shape, ToWorker,
};

/// Sends the answer to a request, or the reason for its refusal.
pub(crate) type Reply<T> = oneshot::Sender<Result<T, Refusal>>;

/// The reason why a request was refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Refusal {
    NoSuchJob(JobId),
    Denied(String),
    NotNow(String),
    /// The catalog rejects the content of the request.
    Content(String),
    TooMany(String),
    Spec(SpecError),
    Catalog(String),
}

/// The answer to a submission.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Submitted {
    pub job: JobId,
    pub existed: bool,
    pub plan: JobPlan,
}

/// A request of the rpc modules to the actor.
pub(crate) enum Command {
    Open {
        session: SessionId,
        hello: WorkerHello,
        say: mpsc::Sender<ToWorker>,
        /// The session's heartbeats that wait in the queue.
        waiting: HeartbeatQueue,
        /// Whether the worker runs on the coordinator's machine.
        here: bool,
    },
    Worker(SessionId, FromWorker),
    /// Reports that were checked against their store.
    Verified {
        store: String,
        reports: Vec<(Reported, StoreCheck)>,
        /// Whether the store that was checked is not the one that the workers write to.
        blind: bool,
    },
    /// A report that differs from the recorded result, with the ruling on the record.
    Judged(SessionId, Finished, Ruling),
    /// A catalog write outside the actor failed. A new life begins, as after a failed write of the
    /// actor.
    Broken(CatalogError),
    /// A job was recorded. Contains its content if the job is active; otherwise only watchers are
    /// notified.
    Learn(Option<Box<NewJob>>, Reply<()>),
    /// Returns this instance's knowledge of one job, or of all jobs.
    Overlay(Option<JobId>, Reply<Overlay>),
    Cancel {
        job: JobId,
        why: String,
        reply: Reply<()>,
    },
    Pause {
        job: JobId,
        paused: bool,
        who: String,
        reply: Reply<()>,
    },
    Drain(String, Reply<u32>),
    /// Asks all workers to check their machines.
    Examine(Examine, Reply<Asked>),
    Retry(JobId, Reply<u64>),
    Workers(Reply<u32>),
    /// Returns which connected workers could run a planned job.
    EligibleWorkers(Arc<JobSpec>, Reply<EligibleWorkers>),
    /// Returns this instance's knowledge without a query to the catalog.
    FarmSnapshot(Reply<FarmSnapshot>),
    /// Returns the seconds until the open stages of jobs are done, as far as known.
    Forecasts(Reply<BTreeMap<JobId, u64>>),
    /// Returns the tasks that wait for workers of a shape.
    Demand(Box<Shape>, Reply<Demand>),
    JobSnapshot {
        job: JobId,
        stage: Option<u32>,
        task: Option<u64>,
        reply: Reply<JobSnapshot>,
    },
}

/// Decides which of two results of a task counts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Ruling {
    /// The reported result counts, because the record of the other one was dropped. Contains the
    /// reason.
    Overruled(String),
    /// The recorded result counts.
    Stands,
    /// This coordinator cannot find out which result counts.
    Unknown,
}

/// The result of checking a report against its store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StoreCheck {
    /// The store contains the reported result.
    Held,
    /// This coordinator cannot check the store.
    Unknown,
    /// The store does not contain the reported result. Contains the reason for the refusal.
    Contradicted(String),
}

/// A message of a worker in its session.
pub(crate) enum FromWorker {
    Credit(u32),
    /// Contains the milliseconds until the worker must end, if known.
    Heartbeat(Vec<LeaseRef>, Vec<TaskProgress>, Option<u64>),
    Done(Finished),
    Failed(Failure),
    /// A report with impossible values on this task. Contains the reason.
    Unusable(LeaseRef, u64, String),
    Release(LeaseRef, String),
    Log(TaskLog),
    Closed,
}

/// Answers a request with the error that the catalog is unavailable.
pub(super) fn refuse(command: Command, error: &str) {
    fn no<T>(reply: Reply<T>, error: &str) {
        let _ = reply.send(Err(Refusal::Catalog(error.to_owned())));
    }
    match command {
        // The session ends because its sender is dropped.
        Command::Open { .. }
        | Command::Worker(..)
        | Command::Verified { .. }
        | Command::Judged(..)
        | Command::Broken(_) => {}
        Command::Learn(_, reply) | Command::Cancel { reply, .. } | Command::Pause { reply, .. } => {
            no(reply, error)
        }
        Command::Overlay(_, reply) => no(reply, error),
        Command::Drain(_, reply) => no(reply, error),
        Command::Examine(_, reply) => no(reply, error),
        Command::Retry(_, reply) => no(reply, error),
        Command::Workers(reply) => no(reply, error),
        Command::EligibleWorkers(_, reply) => no(reply, error),
        Command::FarmSnapshot(reply) => no(reply, error),
        Command::Forecasts(reply) => no(reply, error),
        Command::Demand(_, reply) => no(reply, error),
        Command::JobSnapshot { reply, .. } => no(reply, error),
    }
}
