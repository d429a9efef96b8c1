//! The commands' client for a coordinator: converts between model types and the wire, and adds
//! hints to errors.

use std::time::Duration;

use picofarm_agent::{Access, Bearer, ConnectionFailure, Target, lost_connection};
use picofarm_coordinator::auth::ACCEPTED;
use picofarm_proto::{
    convert::ConvertError,
    ids::JobId,
    model::{
        AuditEntry, ConnectedWorker, Event, JobPlan, JobSpec, JobState, JobStatus, JobSummary,
        Reason, SpecError, TaskExplanation,
    },
    wire::{self, jobs_client::JobsClient},
};
use serde::Serialize;
use tonic::{
    Code as Grpc, Response, Status,
    service::interceptor::InterceptedService,
    transport::{Channel, Endpoint},
};

use crate::error::{CliError, Code, Result};

/// Timeout of a connection attempt, and of the coordinator's first answer if there is another
/// coordinator to try.
const CONNECT: Duration = Duration::from_secs(5);
/// Timeout of the first answer of the last coordinator in a list.
const LAST: Duration = Duration::from_secs(15);
/// Timeout of calls that read or control.
const ANSWER: Duration = Duration::from_secs(60);
/// Timeout of planning and submitting, because a large job is compared with the contents of its
/// stores. Meanwhile, pings show whether the coordinator is alive.
const SUBMIT: Duration = Duration::from_secs(15 * 60);
/// Interval between pings on a connection, and timeout of their answer.
const PING: Duration = Duration::from_secs(10);

type Jobs = JobsClient<InterceptedService<Channel, Bearer>>;

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

/// A connection to a coordinator's job service.
#[derive(Clone)]
pub struct Client {
    jobs: Jobs,
    /// URL of the coordinator in use, and URLs of all coordinators.
    url: String,
    urls: String,
    access: Access,
}

/// Answer to a submission.
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
        // A broken stream has another code, but its cause is a lost connection.
        _ if lost_connection(status) => Code::Coordinator,
        _ => Code::Failed,
    };
    let field = status.metadata().get(SpecError::HEADER);
    CliError {
        denied: matches!(
            status.code(),
            Grpc::Unauthenticated | Grpc::PermissionDenied
        ),
        field: field.and_then(|field| Some(field.to_str().ok()?.to_owned())),
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
    /// Connects to the first coordinator that answers. `urls` is a comma-separated list.
    pub async fn connect(urls: &str, access: &Access) -> Result<Self> {
        let all: Vec<_> = urls.split(',').map(str::trim).collect();
        let (client, url) = first_that_answers(&all, access).await?;
        Ok(Self {
            jobs: client,
            url: url.to_owned(),
            urls: urls.to_owned(),
            access: access.clone(),
        })
    }

    /// Connects again.
    pub async fn reconnect(&self) -> Result<Self> {
        Self::connect(&self.urls, &self.access).await
    }

    /// Returns the answer to a call within a time. If the coordinator is silent and there are
    /// others, the first of them that answers is used from then on. This is safe because every call
    /// is idempotent.
    async fn ask<T, F>(&mut self, within: Duration, call: impl Fn(Jobs) -> F) -> Result<T>
    where
        F: Future<Output = std::result::Result<Response<T>, Status>>,
    {
        let others = self.urls.split(',').map(str::trim);
        let others: Vec<_> = others.filter(|url| *url != self.url).collect();
        let mut silent = match answer(within, call(self.jobs.clone())).await {
            Ok(reply) => return Ok(reply),
            Err(NoAnswer::Unavailable(error)) if others.is_empty() => return Err(error),
            Err(error) => vec![(self.url.as_str(), error.silence()?)],
        };
        for url in others {
            let jobs = match connect_to(url, &self.access, CONNECT).await {
                Ok(jobs) => jobs,
                Err(error) => {
                    silent.push((url, error.silence()?));
                    continue;
                }
            };
            match answer(within, call(jobs.clone())).await {
                Ok(reply) => {
                    tracing::warn!("{} is asked from now on: {}", url, list(&silent));
                    (self.jobs, self.url) = (jobs, url.to_owned());
                    return Ok(reply);
                }
                Err(error) => silent.push((url, error.silence()?)),
            }
        }
        Err(none_answers(&silent))
    }

    pub fn url(&self) -> &str {
        &self.url
    }

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

    /// Finds the only job with an id that begins with `text`.
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

/// The reason why a coordinator gave no usable answer.
enum NoAnswer {
    /// It refused; another coordinator would do the same.
    Refused(CliError),
    /// It, or the connection to it, reported that it cannot answer; another coordinator may.
    Unavailable(CliError),
    /// It was silent or unreachable; another coordinator may answer.
    Silent(CliError),
}

impl NoAnswer {
    fn silent(did: impl std::fmt::Display, hint: &str) -> Self {
        Self::Silent(CliError::new(Code::Coordinator, did).hint(hint))
    }

    /// Returns the error of a silent coordinator.
    ///
    /// # Errors
    /// Fails with the refusal if the coordinator refused.
    fn silence(self) -> Result<CliError> {
        match self {
            Self::Refused(error) => Err(error),
            Self::Unavailable(error) | Self::Silent(error) => Ok(error),
        }
    }
}

/// Returns the answer within a time.
async fn answer<T>(
    within: Duration,
    call: impl Future<Output = std::result::Result<Response<T>, Status>>,
) -> Result<T, NoAnswer> {
    match tokio::time::timeout(within, call).await {
        Ok(Ok(reply)) => Ok(reply.into_inner()),
        Ok(Err(status)) if lost_connection(&status) || status.code() == Grpc::Unavailable => {
            Err(NoAnswer::Unavailable(refused(&status)))
        }
        Ok(Err(status)) => Err(NoAnswer::Refused(refused(&status))),
        Err(_) => Err(NoAnswer::silent(
            format!("it did not answer within {} s", within.as_secs()),
            "it may be frozen or overloaded: see its log and /healthz, then run the same command again",
        )),
    }
}

/// Formats each coordinator as "URL (error)".
fn list(silent: &[(&str, CliError)]) -> String {
    let each = silent
        .iter()
        .map(|(url, error)| format!("{url} ({})", error.message));
    each.collect::<Vec<_>>().join(", ")
}

/// Returns the error for the case that no coordinator answers.
fn none_answers(silent: &[(&str, CliError)]) -> CliError {
    let error = CliError::new(
        Code::Coordinator,
        format!("no coordinator answers at {}", list(silent)),
    );
    CliError {
        hint: silent.first().and_then(|(_, error)| error.hint.clone()),
        ..error
    }
}

/// Connects to the first of these coordinators that answers.
///
/// # Errors
/// Fails if the settings are unusable for one of them, or if none answers. The error describes each
/// coordinator.
async fn first_that_answers<'a>(urls: &[&'a str], access: &Access) -> Result<(Jobs, &'a str)> {
    let (mut silent, mut wrong) = (Vec::new(), None);
    for (i, url) in urls.iter().enumerate() {
        // The last coordinator has a longer timeout, because there is no other to try.
        let within = match i + 1 == urls.len() {
            true => LAST,
            false => CONNECT,
        };
        match connect_to(url, access, within).await {
            Ok(jobs) => return Ok((jobs, *url)),
            Err(no) => match no.silence() {
                Ok(error) => silent.push((*url, error)),
                // A wrong setting for one coordinator does not prevent another from answering.
                Err(error) => {
                    wrong.get_or_insert(error);
                }
            },
        }
    }
    let Some(wrong) = wrong else {
        return Err(none_answers(&silent));
    };
    let message = match silent.is_empty() {
        true => wrong.message,
        false => format!(
            "{}; no coordinator answers at {}",
            wrong.message,
            list(&silent)
        ),
    };
    Err(CliError { message, ..wrong })
}

/// Connects to one coordinator and waits for its first answer, each with a timeout.
async fn connect_to(url: &str, access: &Access, within: Duration) -> Result<Jobs, NoAnswer> {
    let target = access
        .target(url)
        .map_err(|e| NoAnswer::Refused(CliError::input(format!("coordinator: {e}"))))?;
    let endpoint = lively(target.endpoint.clone()).connect_timeout(CONNECT);
    let channel = match tokio::time::timeout(CONNECT, endpoint.connect()).await {
        Ok(Ok(channel)) => channel,
        Ok(Err(e)) => return Err(no_connection(&target, &e).await),
        Err(_) => return Err(mute("it did not complete the connection", CONNECT)),
    };
    let mut jobs = JobsClient::with_interceptor(channel, target.bearer.clone())
        .max_decoding_message_size(64 << 20);
    // A client certificate is refused only after the handshake, and a TLS port refuses plain HTTP
    // only on the first request. The first call reveals both.
    let first = jobs.get_server_info(wire::GetServerInfoRequest {});
    match tokio::time::timeout(within, first).await {
        Ok(Err(status)) if lost_connection(&status) => Err(no_connection(&target, &status).await),
        Ok(_) => Ok(jobs),
        Err(_) => Err(mute("it took the connection and did not answer", within)),
    }
}

/// Enables pings, so that a connection to a frozen or vanished coordinator ends.
fn lively(endpoint: Endpoint) -> Endpoint {
    endpoint
        .tcp_nodelay(true)
        .http2_keep_alive_interval(PING)
        .keep_alive_timeout(PING)
        .keep_alive_while_idle(true)
}

fn down(did: impl std::fmt::Display) -> NoAnswer {
    NoAnswer::silent(
        did,
        "start one with `picofarm up`, or name another with --coordinator or PICOFARM_COORDINATOR",
    )
}

fn mute(did: &str, within: Duration) -> NoAnswer {
    down(format!("{did} within {} s", within.as_secs()))
}

/// Returns the reason why there is no connection.
async fn no_connection(
    target: &Target,
    error: &(dyn std::error::Error + Send + Sync + 'static),
) -> NoAnswer {
    match tokio::time::timeout(CONNECT, target.diagnose(error)).await {
        Ok(ConnectionFailure::Mismatch(what)) => {
            NoAnswer::Refused(CliError::new(Code::Coordinator, what))
        }
        Ok(ConnectionFailure::Down(why)) => down(why),
        Err(_) => mute("it did not complete the connection", CONNECT),
    }
}

/// A coordinator's answer about a proof.
pub enum Standing {
    /// It accepts callers with this proof, for this reason.
    Accepted(String),
    /// It refuses callers with this proof.
    Refused(String),
    /// It cannot be asked.
    Unknown(String),
}

/// Asks the coordinator at `url` whether a proof is accepted. `proof` is the SHA-256 of a token, or
/// the name in a client certificate, with the scheme as prefix.
pub async fn standing(url: &str, access: &Access, proof: &str) -> Standing {
    let words = |no: NoAnswer| no.silence().unwrap_or_else(|refused| refused).message;
    // The request is not about the caller, so the caller's own token is not sent.
    let asker = Access {
        token: None,
        ..access.clone()
    };
    let ask = async {
        let target = asker.target(url).map_err(|e| e.to_string())?;
        let bearer = Bearer::plain(proof).map_err(|e| e.to_string())?;
        let endpoint = lively(target.endpoint.clone()).connect_timeout(CONNECT);
        let channel = match endpoint.connect().await {
            Ok(channel) => channel,
            Err(e) => return Err(words(no_connection(&target, &e).await)),
        };
        let mut jobs = JobsClient::with_interceptor(channel, bearer);
        match jobs.get_server_info(wire::GetServerInfoRequest {}).await {
            Ok(_) => Ok(Standing::Accepted("it asks nobody for a token".into())),
            Err(status) => match status.metadata().get(ACCEPTED).map(|v| v.as_bytes()) {
                Some(b"yes") => Ok(Standing::Accepted(status.message().to_owned())),
                Some(b"no") => Ok(Standing::Refused(status.message().to_owned())),
                _ if lost_connection(&status) => Err(words(no_connection(&target, &status).await)),
                _ => Err(format!(
                    "it is of a version that does not answer this question ({})",
                    status.message()
                )),
            },
        }
    };
    match tokio::time::timeout(2 * CONNECT, ask).await {
        Ok(Ok(standing)) => standing,
        Ok(Err(why)) => Standing::Unknown(why),
        Err(_) => Standing::Unknown(format!(
            "it did not answer within {} s",
            (2 * CONNECT).as_secs()
        )),
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_coordinator_that_takes_connections_and_never_answers_is_left() {
        let mute = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let mute = format!("http://{}", mute.local_addr().unwrap());
        let soon = Duration::from_millis(100);
        let Err(no) = connect_to(&mute, &Access::default(), soon).await else {
            panic!("nobody answers");
        };
        let said = no.silence().map(|error| error.message).unwrap();
        assert!(
            said.contains("took the connection and did not answer"),
            "{said}"
        );
        let never = std::future::pending::<std::result::Result<Response<()>, Status>>();
        let Err(no) = answer(soon, never).await else {
            panic!("nobody answers");
        };
        let silent = [
            ("http://a", no.silence().unwrap()),
            ("http://b", CliError::input("x")),
        ];
        let error = none_answers(&silent);
        assert_eq!(error.code, Code::Coordinator);
        let said =
            "no coordinator answers at http://a (it did not answer within 0 s), http://b (x)";
        assert_eq!(error.message, said);
    }
}
