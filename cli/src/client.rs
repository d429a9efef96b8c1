//! The coordinator as the commands see it: model types in, model types out, errors with a hint.

use std::time::Duration;

use picofarm_agent::{Access, Bearer, Target, Trouble, lost_connection};
use picofarm_proto::{
    convert::ConvertError,
    ids::JobId,
    model::{
        AuditEntry, ConnectedWorker, Event, JobPlan, JobSpec, JobState, JobStatus, JobSummary,
        Reason, TaskExplanation,
    },
    wire::{self, jobs_client::JobsClient},
};
use serde::Serialize;
use tonic::{Code as Grpc, Status, service::interceptor::InterceptedService, transport::Channel};

use crate::error::{CliError, Code, Result};

/// A connection to a coordinator's job service.
#[derive(Clone)]
pub struct Client {
    jobs: JobsClient<InterceptedService<Channel, Bearer>>,
    /// The coordinator in use, and all there are.
    url: String,
    urls: String,
    access: Access,
}

/// What a submission answered.
pub struct Submitted {
    pub job: JobId,
    pub existed: bool,
    pub plan: JobPlan,
}

fn refused(status: &Status) -> CliError {
    let code = match status.code() {
        Grpc::InvalidArgument | Grpc::NotFound | Grpc::OutOfRange => Code::Input,
        Grpc::ResourceExhausted => Code::Resource,
        Grpc::Unavailable
        | Grpc::FailedPrecondition
        | Grpc::Unimplemented
        | Grpc::Unauthenticated
        | Grpc::PermissionDenied => Code::Coordinator,
        // A stream that breaks off has other codes, but a cause: no connection any more.
        _ if lost_connection(status) => Code::Coordinator,
        _ => Code::Failed,
    };
    CliError {
        denied: matches!(
            status.code(),
            Grpc::Unauthenticated | Grpc::PermissionDenied
        ),
        ..CliError::new(code, status.message())
    }
}

fn unreadable(e: ConvertError) -> CliError {
    CliError::new(
        Code::Coordinator,
        format!("the coordinator's answer cannot be read: {e}"),
    )
    .hint("is it of another version? compare `picofarm --version` on both sides")
}

fn required<T>(value: Option<T>, field: &'static str) -> Result<T> {
    value.ok_or_else(|| unreadable(ConvertError::Missing { field }))
}

impl Client {
    /// Connects to the first coordinator that answers, of a list of URLs with commas between them; each gets five
    /// seconds.
    pub async fn connect(urls: &str, access: &Access) -> Result<Self> {
        let mut first = None;
        for url in urls.split(',') {
            match Self::connect_to(url.trim(), access).await {
                Ok(client) => {
                    return Ok(Self {
                        urls: urls.to_owned(),
                        ..client
                    });
                }
                Err(error) => first = first.or(Some(error)),
            }
        }
        Err(first.expect("a text has at least one part between commas"))
    }

    async fn connect_to(url: &str, access: &Access) -> Result<Self> {
        let target = access
            .target(url)
            .map_err(|e| CliError::input(format!("coordinator: {e}")))?;
        let endpoint = target.endpoint.clone();
        let connected = endpoint
            .connect_timeout(Duration::from_secs(5))
            .connect()
            .await;
        let channel = match connected {
            Ok(channel) => channel,
            Err(e) => return Err(no_connection(&target, url, &e).await),
        };
        let jobs = JobsClient::with_interceptor(channel, target.bearer.clone())
            .max_decoding_message_size(64 << 20);
        let mut client = Self {
            jobs,
            url: url.to_owned(),
            urls: url.to_owned(),
            access: access.clone(),
        };
        // A client certificate is refused only after the handshake, and plain HTTP by a TLS port only when it is spoken:
        // the first call tells.
        let asked = client
            .jobs
            .get_server_info(wire::GetServerInfoRequest {})
            .await;
        if let Err(status) = asked
            && lost_connection(&status)
        {
            return Err(no_connection(&target, url, &status).await);
        }
        Ok(client)
    }

    /// Connects again.
    pub async fn reconnect(&self) -> Result<Self> {
        Self::connect(&self.urls, &self.access).await
    }

    pub fn url(&self) -> &str {
        &self.url
    }

    /// (version, protocol, workers connected).
    pub async fn server(&mut self) -> Result<(String, u32, u32)> {
        let info = self
            .jobs
            .get_server_info(wire::GetServerInfoRequest {})
            .await
            .map_err(|s| refused(&s))?
            .into_inner();
        Ok((info.version, info.protocol, info.workers))
    }

    pub async fn plan(&mut self, spec: JobSpec) -> Result<JobPlan> {
        let request = wire::PlanJobRequest {
            spec: Some(spec.into()),
        };
        let reply = self.jobs.plan_job(request).await.map_err(|s| refused(&s))?;
        required(reply.into_inner().plan, "plan")?
            .try_into()
            .map_err(unreadable)
    }

    pub async fn submit(&mut self, spec: JobSpec, again: bool) -> Result<Submitted> {
        let request = wire::SubmitJobRequest {
            spec: Some(spec.into()),
            again,
        };
        let reply = self
            .jobs
            .submit_job(request)
            .await
            .map_err(|s| refused(&s))?
            .into_inner();
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

    /// A page of the list of jobs, and where the next begins.
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
        let reply = self.jobs.list_jobs(request).await;
        let reply = reply.map_err(|s| refused(&s))?.into_inner();
        let jobs = reply.jobs.into_iter();
        let jobs = jobs.map(|j| j.try_into().map_err(unreadable));
        let next = Some(reply.next_page_token).filter(|token| !token.is_empty());
        Ok((jobs.collect::<Result<_>>()?, next))
    }

    pub async fn status(&mut self, job: JobId) -> Result<JobStatus> {
        let request = wire::GetJobRequest {
            job_id: job.to_string(),
        };
        let reply = self.jobs.get_job(request).await.map_err(|s| refused(&s))?;
        required(reply.into_inner().job, "job")?
            .try_into()
            .map_err(unreadable)
    }

    /// Finds the one job whose id begins with `text`.
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
                "{text:?} fits several jobs, e.g. {} and {}",
                a.id, b.id
            ))
            .hint("give more letters of the id")),
            _ => Err(CliError::input(format!("no job {text:?}")).hint("see `picofarm job list`")),
        }
    }

    /// Streams statuses until the job ends.
    pub async fn watch(&mut self, job: JobId) -> Result<Watch> {
        let request = wire::WatchJobRequest {
            job_id: job.to_string(),
        };
        let stream = self
            .jobs
            .watch_job(request)
            .await
            .map_err(|s| refused(&s))?;
        Ok(Watch(stream.into_inner()))
    }

    pub async fn cancel(&mut self, job: JobId) -> Result<JobStatus> {
        let request = wire::CancelJobRequest {
            job_id: job.to_string(),
        };
        let reply = self
            .jobs
            .cancel_job(request)
            .await
            .map_err(|s| refused(&s))?;
        required(reply.into_inner().job, "job")?
            .try_into()
            .map_err(unreadable)
    }

    pub async fn retry(&mut self, job: JobId) -> Result<u64> {
        let request = wire::RetryJobRequest {
            job_id: job.to_string(),
        };
        let reply = self
            .jobs
            .retry_job(request)
            .await
            .map_err(|s| refused(&s))?;
        Ok(reply.into_inner().retried)
    }

    /// Holds a job, or lets it go on.
    pub async fn pause(&mut self, job: JobId, paused: bool) -> Result<JobStatus> {
        let job_id = job.to_string();
        let status = match paused {
            true => {
                let request = wire::PauseJobRequest { job_id };
                let reply = self.jobs.pause_job(request).await;
                reply.map_err(|s| refused(&s))?.into_inner().job
            }
            false => {
                let request = wire::ResumeJobRequest { job_id };
                let reply = self.jobs.resume_job(request).await;
                reply.map_err(|s| refused(&s))?.into_inner().job
            }
        };
        required(status, "job")?.try_into().map_err(unreadable)
    }

    /// Tells workers of this name or id to end; how many there are.
    pub async fn drain(&mut self, worker: &str) -> Result<u32> {
        let request = wire::DrainWorkerRequest {
            worker: worker.to_owned(),
        };
        let reply = self.jobs.drain_worker(request).await;
        Ok(reply.map_err(|s| refused(&s))?.into_inner().workers)
    }

    /// A job's events after a sequence number, at most a thousand.
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

    /// A page of the history, and whether its job had ended before it was read.
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
        let reply = self
            .jobs
            .list_events(request)
            .await
            .map_err(|s| refused(&s))?
            .into_inner();
        let events = reply.events.into_iter().map(TryInto::try_into);
        let events = events.collect::<Result<_, _>>().map_err(unreadable)?;
        Ok((events, reply.ended))
    }

    /// Why a job, or a task of it, is as it is.
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
        let reply = self
            .jobs
            .explain_job(request)
            .await
            .map_err(|s| refused(&s))?
            .into_inner();
        Ok(Explained {
            job: required(reply.job, "job")?.try_into().map_err(unreadable)?,
            reasons: reply.reasons.into_iter().map(Into::into).collect(),
            task: reply
                .task
                .map(TryInto::try_into)
                .transpose()
                .map_err(unreadable)?,
        })
    }

    /// A page of the audit log, newest first: lines with smaller sequence numbers than `before`.
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
        let reply = self.jobs.list_audit(request).await;
        let entries = reply.map_err(|s| refused(&s))?.into_inner().entries;
        let entries = entries.into_iter().map(TryInto::try_into);
        entries.collect::<Result<_, _>>().map_err(unreadable)
    }

    /// The workers connected to the coordinator that answers.
    pub async fn workers(&mut self) -> Result<Workers> {
        let reply = self
            .jobs
            .list_workers(wire::ListWorkersRequest {})
            .await
            .map_err(|s| refused(&s))?
            .into_inner();
        Ok(Workers {
            coordinator: reply.coordinator,
            workers: reply.workers.into_iter().map(Into::into).collect(),
            elsewhere: reply.elsewhere,
            coordinators: reply.coordinators,
        })
    }
}

/// Which jobs of the list.
#[derive(Default)]
pub struct Listing<'a> {
    /// At most so many; 0 = as many as the coordinator gives.
    pub limit: u32,
    /// Where to begin, as an earlier page said.
    pub page: Option<&'a str>,
    /// Only those that stand so.
    pub state: Option<JobState>,
    /// Only this user's.
    pub user: Option<&'a str>,
    /// Only those of this name, or whose id begins so.
    pub find: Option<&'a str>,
}

/// Which part of the history.
#[derive(Debug, Clone, Copy)]
pub struct Page {
    /// `None` = of all jobs.
    pub job: Option<JobId>,
    /// Position of the stage in the job.
    pub stage: Option<u32>,
    pub task: Option<u64>,
    /// Only events after this sequence number.
    pub after: u64,
    pub limit: u32,
    /// The last `limit` rather than the first.
    pub newest: bool,
    /// What tasks logged, too.
    pub logs: bool,
}

/// Answer to the question why.
#[derive(Debug, Serialize)]
pub struct Explained {
    pub job: JobStatus,
    pub reasons: Vec<Reason>,
    pub task: Option<TaskExplanation>,
}

/// Who works for a coordinator.
#[derive(Debug, Serialize)]
pub struct Workers {
    /// Names the process that answered.
    pub coordinator: String,
    pub workers: Vec<ConnectedWorker>,
    /// Workers connected to other coordinators of the same catalog.
    pub elsewhere: u32,
    /// Coordinators of the catalog.
    pub coordinators: u32,
}

/// Why there is no connection.
async fn no_connection(
    target: &Target,
    url: &str,
    error: &(dyn std::error::Error + Send + Sync + 'static),
) -> CliError {
    match target.trouble(error).await {
        Trouble::Mismatch(what) => CliError::new(Code::Coordinator, what),
        Trouble::Down(_) => {
            CliError::new(Code::Coordinator, format!("no coordinator answers at {url}")).hint(
                "start one with `picofarm up`, or name another with --coordinator or PICOFARM_COORDINATOR",
            )
        }
    }
}

/// A stream of statuses.
pub struct Watch(tonic::Streaming<wire::WatchJobResponse>);

impl Watch {
    /// The next status; `None` when the job has ended.
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
