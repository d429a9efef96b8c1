//! The calls of the job service.

use std::time::Duration;

use picofarm_proto::{
    convert::ConvertError,
    ids::JobId,
    messages::{
        AuditEntry, ConnectedWorker, Event, ExaminedWorker, JobPlan, JobState, JobStatus,
        JobSummary, Reason, TaskExplanation, UsageBy, UsageRow,
    },
    spec::JobSpec,
    wire,
};
use serde::Serialize;

use super::{Client, refused, required, unreadable};
use crate::error::{CliError, Result};

/// Timeout of calls that read or control.
pub(super) const ANSWER: Duration = Duration::from_secs(60);
/// Timeout of planning and submitting, because a large job is compared with the contents of its
/// stores. Meanwhile, pings show whether the coordinator is alive.
const SUBMIT: Duration = Duration::from_secs(15 * 60);

/// Calls a method of the coordinator with a timeout.
macro_rules! call {
    ($client:ident, $within:expr, $method:ident, $request:expr) => {{
        let request = $request;
        $client
            .ask($within, |mut jobs| {
                let request = request.clone();
                async move { jobs.$method(request).await }
            })
            .await?
    }};
}

/// Answer to a submission.
pub struct Submitted {
    pub job: JobId,
    pub existed: bool,
    pub plan: JobPlan,
}

impl Client {
    /// Returns the server's version, protocol and number of connected workers.
    pub async fn server(&mut self) -> Result<(String, u32, u32)> {
        let info = call!(self, ANSWER, get_server_info, wire::GetServerInfoRequest {});
        Ok((info.version, info.protocol, info.workers))
    }

    pub async fn plan(&mut self, spec: JobSpec) -> Result<JobPlan> {
        let request = wire::PlanJobRequest {
            spec: Some(spec.into()),
        };
        let reply = call!(self, SUBMIT, plan_job, request);
        required(reply.plan, "plan")?.try_into().map_err(unreadable)
    }

    pub async fn submit(&mut self, spec: JobSpec, again: bool) -> Result<Submitted> {
        let request = wire::SubmitJobRequest {
            spec: Some(spec.into()),
            again,
        };
        let reply = call!(self, SUBMIT, submit_job, request);
        Ok(Submitted {
            job: reply.job_id.parse().map_err(|e| {
                unreadable(ConvertError::Invalid {
                    field: "job_id",
                    what: format!("{e}"),
                })
            })?,
            existed: reply.existed,
            plan: required(reply.plan, "plan")?
                .try_into()
                .map_err(unreadable)?,
        })
    }

    /// Returns a page of the list of jobs, and the start of the next page.
    pub async fn list(&mut self, ask: &Listing<'_>) -> Result<(Vec<JobSummary>, Option<String>)> {
        let request = wire::ListJobsRequest {
            page_size: ask.limit,
            page_token: ask.page.unwrap_or_default().into(),
            state: ask
                .state
                .map_or(0, |state| wire::JobState::from(state).into()),
            user: ask.user.unwrap_or_default().into(),
            find: ask.find.unwrap_or_default().into(),
        };
        let reply = call!(self, ANSWER, list_jobs, request);
        let jobs = reply.jobs.into_iter();
        let jobs = jobs.map(|j| j.try_into().map_err(unreadable));
        let next = Some(reply.next_page_token).filter(|token| !token.is_empty());
        Ok((jobs.collect::<Result<_>>()?, next))
    }

    pub async fn status(&mut self, job: JobId) -> Result<JobStatus> {
        let request = wire::GetJobRequest {
            job_id: job.to_string(),
        };
        let reply = call!(self, ANSWER, get_job, request);
        required(reply.job, "job")?.try_into().map_err(unreadable)
    }

    /// Finds a job by its id or the beginning of it, by its number, its name, or as `last`: the
    /// caller's latest.
    pub async fn find(&mut self, text: &str) -> Result<JobId> {
        if let Ok(id) = text.parse() {
            return Ok(id);
        }
        if text.is_empty() {
            return Err(CliError::input("no job is named").hint("see `picofarm job list`"));
        }
        let two = Listing {
            limit: 2,
            find: Some(text),
            ..Listing::default()
        };
        let (jobs, _) = self.list(&two).await?;
        let mut matching = jobs.iter();
        match (matching.next(), matching.next()) {
            (Some(job), None) => Ok(job.id),
            (Some(a), Some(b)) => Err(CliError::input(format!(
                "{text:?} fits several jobs, e.g. {} ({}) and {} ({})",
                a.number, a.id, b.number, b.id
            ))
            .hint("give the number of the job, or its id")),
            _ => Err(CliError::input(format!("no job {text:?}")).hint("see `picofarm job list`")),
        }
    }

    /// Streams statuses until the job ends.
    pub async fn watch(&mut self, job: JobId) -> Result<Watch> {
        let request = wire::WatchJobRequest {
            job_id: job.to_string(),
        };
        Ok(Watch(call!(self, ANSWER, watch_job, request)))
    }

    pub async fn cancel(&mut self, job: JobId) -> Result<JobStatus> {
        let request = wire::CancelJobRequest {
            job_id: job.to_string(),
        };
        let reply = call!(self, ANSWER, cancel_job, request);
        required(reply.job, "job")?.try_into().map_err(unreadable)
    }

    /// A job as it was submitted, with its lists of files.
    pub async fn spec(&mut self, job: JobId) -> Result<JobSpec> {
        let request = wire::GetJobSpecRequest {
            job_id: job.to_string(),
        };
        let reply = call!(self, SUBMIT, get_job_spec, request);
        required(reply.spec, "spec")?.try_into().map_err(unreadable)
    }

    pub async fn retry(&mut self, job: JobId) -> Result<u64> {
        let request = wire::RetryJobRequest {
            job_id: job.to_string(),
        };
        Ok(call!(self, ANSWER, retry_job, request).retried)
    }

    /// Pauses or resumes a job.
    pub async fn pause(&mut self, job: JobId, paused: bool) -> Result<JobStatus> {
        let job_id = job.to_string();
        let status = match paused {
            true => {
                let request = wire::PauseJobRequest { job_id };
                call!(self, ANSWER, pause_job, request).job
            }
            false => {
                let request = wire::ResumeJobRequest { job_id };
                call!(self, ANSWER, resume_job, request).job
            }
        };
        required(status, "job")?.try_into().map_err(unreadable)
    }

    /// Drains the workers of this name or id, and returns their number.
    pub async fn drain(&mut self, worker: &str) -> Result<u32> {
        let request = wire::DrainWorkerRequest {
            worker: worker.to_owned(),
        };
        Ok(call!(self, ANSWER, drain_worker, request).workers)
    }

    /// Returns a job's events after a sequence number, at most a thousand.
    pub async fn events(
        &mut self,
        job: JobId,
        after: u64,
        task: Option<u64>,
    ) -> Result<Vec<Event>> {
        let page = Page {
            job: Some(job),
            stage: None,
            task,
            after,
            limit: 1000,
            newest: false,
            logs: false,
        };
        Ok(self.history(page).await?.0)
    }

    /// Returns a page of the history, and whether its job had ended before the page was read.
    pub async fn history(&mut self, page: Page) -> Result<(Vec<Event>, bool)> {
        let request = wire::ListEventsRequest {
            job_id: page.job.map(|job| job.to_string()).unwrap_or_default(),
            after: page.after,
            limit: page.limit,
            task: page.task,
            stage: page.stage,
            newest: page.newest,
            logs: page.logs,
        };
        let reply = call!(self, ANSWER, list_events, request);
        let events = reply.events.into_iter().map(TryInto::try_into);
        let events = events.collect::<Result<_, _>>().map_err(unreadable)?;
        Ok((events, reply.ended))
    }

    /// Explains the state of a job or of one of its tasks.
    pub async fn explain(
        &mut self,
        job: JobId,
        stage: u32,
        task: Option<u64>,
    ) -> Result<Explained> {
        let request = wire::ExplainJobRequest {
            job_id: job.to_string(),
            stage,
            task,
        };
        let reply = call!(self, ANSWER, explain_job, request);
        Ok(Explained {
            job: required(reply.job, "job")?.try_into().map_err(unreadable)?,
            reasons: reply.reasons.into_iter().map(Into::into).collect(),
            task: reply
                .task
                .map(TryInto::try_into)
                .transpose()
                .map_err(unreadable)?,
            may_change: reply.may_change,
        })
    }

    /// Returns a page of the audit log, newest first: lines with smaller sequence numbers than
    /// `before`.
    pub async fn audit(
        &mut self,
        before: Option<u64>,
        limit: u32,
        who: Option<&str>,
        job: Option<JobId>,
    ) -> Result<Vec<AuditEntry>> {
        let request = wire::ListAuditRequest {
            before: before.unwrap_or(0),
            limit,
            who: who.unwrap_or_default().to_owned(),
            job_id: job.map(|job| job.to_string()).unwrap_or_default(),
        };
        let entries = call!(self, ANSWER, list_audit, request).entries;
        let entries = entries.into_iter().map(TryInto::try_into);
        entries.collect::<Result<_, _>>().map_err(unreadable)
    }

    /// Returns what jobs consumed from one day (since 1970-01-01, UTC) until before another.
    pub async fn usage(
        &mut self,
        by: UsageBy,
        (since_day, until_day): (i64, i64),
    ) -> Result<Vec<UsageRow>> {
        let request = wire::GetUsageRequest {
            by: by.name().to_owned(),
            since_day,
            until_day,
        };
        let rows = call!(self, ANSWER, get_usage, request).rows;
        Ok(rows.into_iter().map(Into::into).collect())
    }

    /// Asks the workers of a coordinator to check their machines. Returns them, and the number of
    /// workers connected to other coordinators.
    pub async fn examine(&mut self, what: &Examination) -> Result<(Vec<ExaminedWorker>, u32)> {
        let request = wire::ExamineWorkersRequest {
            store: what.store.clone(),
            scenes: what.scenes.clone(),
            within_ms: u32::try_from(what.within.as_millis()).unwrap_or(u32::MAX),
        };
        let reply = call!(self, what.within + ANSWER, examine_workers, request);
        let workers = reply.workers.into_iter().map(Into::into);
        Ok((workers.collect(), reply.elsewhere))
    }

    /// Returns the workers connected to the coordinator that answers.
    pub async fn workers(&mut self) -> Result<Workers> {
        let reply = call!(self, ANSWER, list_workers, wire::ListWorkersRequest {});
        Ok(Workers {
            coordinator: reply.coordinator,
            workers: reply.workers.into_iter().map(Into::into).collect(),
            elsewhere: reply.elsewhere,
            coordinators: reply.coordinators,
        })
    }
}

/// What workers are asked to check.
pub struct Examination {
    /// Store; may be empty.
    pub store: String,
    /// Scene file or folder; may be empty.
    pub scenes: String,
    /// Time to wait for answers.
    pub within: Duration,
}

/// Selects jobs of the list.
#[derive(Default)]
pub struct Listing<'a> {
    /// Maximum number of jobs; 0 = the coordinator's limit.
    pub limit: u32,
    /// Start of the page, as returned with the previous page.
    pub page: Option<&'a str>,
    /// Only jobs in this state.
    pub state: Option<JobState>,
    /// Only jobs of this user.
    pub user: Option<&'a str>,
    /// Only jobs with this name, or with an id that begins with it.
    pub find: Option<&'a str>,
}

/// Selects a part of the history.
#[derive(Debug, Clone, Copy)]
pub struct Page {
    /// The job; `None` = all jobs.
    pub job: Option<JobId>,
    /// Position of the stage in the job.
    pub stage: Option<u32>,
    pub task: Option<u64>,
    /// Only events after this sequence number.
    pub after: u64,
    pub limit: u32,
    /// Selects the last `limit` events instead of the first.
    pub newest: bool,
    /// Includes the logs of tasks.
    pub logs: bool,
}

/// An explanation of a job's state.
#[derive(Debug, Serialize)]
pub struct Explained {
    pub job: JobStatus,
    pub reasons: Vec<Reason>,
    pub task: Option<TaskExplanation>,
    /// Whether the caller's rights suffice to change the job.
    #[serde(skip)]
    pub may_change: bool,
}

/// The workers of a coordinator.
#[derive(Debug, Serialize)]
pub struct Workers {
    /// Name of the process that answered.
    pub coordinator: String,
    pub workers: Vec<ConnectedWorker>,
    /// Number of workers connected to other coordinators of the same catalog.
    pub elsewhere: u32,
    /// Number of coordinators of the catalog.
    pub coordinators: u32,
}

/// A stream of statuses.
pub struct Watch(tonic::Streaming<wire::WatchJobResponse>);

impl Watch {
    /// Returns the next status; `None` when the job has ended.
    pub async fn next(&mut self) -> Result<Option<JobStatus>> {
        match self.0.message().await {
            Ok(None) => Ok(None),
            Ok(Some(reply)) => required(reply.job, "job")?
                .try_into()
                .map(Some)
                .map_err(unreadable),
            Err(status) => Err(refused(&status)),
        }
    }
}
