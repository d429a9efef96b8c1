//! Service `Jobs`: the requests of clients.

use std::{pin::Pin, sync::Arc};

use futures::{Stream, TryStreamExt};
use picofarm_catalog::{AuditQuery, EventQuery};
use picofarm_proto::{
    PROTOCOL,
    convert::ConvertError,
    ids::JobId,
    messages::{Act, JobState},
    spec::bounds,
    wire::{self, jobs_server::Jobs},
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::{
    examine::examine,
    link::{Link, account, caller, invalid, refused},
    look,
    requests::{draft, filter, job_id, listing, usage},
    watch::watch_while_allowed,
};
use crate::{
    actor::{Command, Submitted},
    auth::{Caller, OwnCode, Quotas},
    core::VERSION,
    memory::Account,
    submission::{Draft, UserLimits},
};

/// Default and largest number of events in one answer: some 4 MB with the longest messages.
const EVENTS: u32 = 1_000;
/// Memory of a line of history or of the audit log, or of a job in a list, while it is read and
/// sent: three times the size of all but the longest few.
const LINE: u64 = 8 << 10;
/// Memory of a worker in a list, while it is read and sent.
const WORKER: u64 = 4 << 10;

pub(crate) struct JobsService {
    link: Link,
    quotas: Quotas,
    own_code: Arc<OwnCode>,
}

impl JobsService {
    pub(crate) fn new(link: Link, quotas: Quotas, own_code: OwnCode) -> Self {
        Self {
            link,
            quotas,
            own_code: Arc::new(own_code),
        }
    }

    /// Reads and checks a spec on a separate thread, because a large one takes seconds.
    async fn draft(
        &self,
        wire: Option<wire::JobSpec>,
        by: &Caller,
        account: &Account,
    ) -> Result<Arc<Draft>, Status> {
        let wire = wire.ok_or_else(|| invalid(ConvertError::Missing { field: "spec" }))?;
        let charge = account.charge_spec(&wire.json).await?;
        let account = account.clone();
        let (bytes, quotas, by) = (wire.json.len(), self.quotas, by.clone());
        let own_code = Arc::clone(&self.own_code);
        let draft = self
            .link
            .lanes
            .heavy(bytes, move || async move {
                draft(wire, bytes, (&quotas, &own_code), &by, (account, charge))
            })
            .await?;
        Ok(Arc::new(draft))
    }
}

impl JobsService {
    async fn pause(
        &self,
        job: JobId,
        paused: bool,
        by: &Caller,
        account: &Account,
    ) -> Result<wire::JobStatus, Status> {
        let act = if paused { Act::Pause } else { Act::Resume };
        let pause = |reply| Command::Pause {
            job,
            paused,
            who: format!("by {}", by.name),
            reply,
        };
        self.link.steer(by, act, job, pause).await?;
        Ok(self.link.status(account, job).await?.into())
    }

    async fn submit(
        &self,
        request: wire::SubmitJobRequest,
        by: &Caller,
        account: &Account,
    ) -> Result<Submitted, Status> {
        let draft = self.draft(request.spec, by, account).await?;
        let most = UserLimits {
            jobs: self.quotas.jobs_per_user as u64,
            bytes: by.max_bytes().or(self.quotas.bytes_per_user),
        };
        let submissions = &self.link.submissions;
        let submitted = submissions.submit(&draft, by, most, request.again).await;
        submitted.map_err(refused)
    }
}

#[tonic::async_trait]
impl Jobs for JobsService {
    async fn get_server_info(
        &self,
        _: Request<wire::GetServerInfoRequest>,
    ) -> Result<Response<wire::GetServerInfoResponse>, Status> {
        Ok(Response::new(wire::GetServerInfoResponse {
            version: VERSION.into(),
            protocol: PROTOCOL,
            workers: self.link.ask(Command::Workers).await?,
        }))
    }

    async fn plan_job(
        &self,
        request: Request<wire::PlanJobRequest>,
    ) -> Result<Response<wire::PlanJobResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let draft = self.draft(request.into_inner().spec, &by, &account).await?;
        let plan = self.link.submissions.plan(&draft, &by).await;
        let plan = plan.map_err(refused)?;
        Ok(Response::new(wire::PlanJobResponse {
            plan: Some(plan.into()),
        }))
    }

    async fn submit_job(
        &self,
        request: Request<wire::SubmitJobRequest>,
    ) -> Result<Response<wire::SubmitJobResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let answer = self.submit(request.into_inner(), &by, &account).await;
        let job = answer.as_ref().ok().map(|submitted| submitted.job);
        let done = match &answer {
            Ok(Submitted { existed: true, .. }) => "the same job is there already",
            _ => "",
        };
        self.link
            .audit
            .record(&by.name, Act::Submit, job, &answer, done)
            .await;
        let submitted = answer?;
        Ok(Response::new(wire::SubmitJobResponse {
            job_id: submitted.job.to_string(),
            existed: submitted.existed,
            plan: Some(submitted.plan.into()),
        }))
    }

    async fn list_jobs(
        &self,
        request: Request<wire::ListJobsRequest>,
    ) -> Result<Response<wire::ListJobsResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let query = listing(request.into_inner(), &by, by.sight(self.link.visibility))?;
        let charge = account.charge("the list", LINE * u64::from(query.limit));
        let _charge = charge.await?;
        let page = self.link.page(query).await?;
        Ok(Response::new(wire::ListJobsResponse {
            jobs: page.jobs.into_iter().map(Into::into).collect(),
            next_page_token: page.next.map(|key| key.to_string()).unwrap_or_default(),
        }))
    }

    async fn get_job(
        &self,
        request: Request<wire::GetJobRequest>,
    ) -> Result<Response<wire::GetJobResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let id = job_id(&request.into_inner().job_id)?;
        self.link.may_see(&by, id).await?;
        let job = self.link.status(&account, id).await?;
        Ok(Response::new(wire::GetJobResponse {
            job: Some(job.into()),
        }))
    }

    async fn get_job_spec(
        &self,
        request: Request<wire::GetJobSpecRequest>,
    ) -> Result<Response<wire::GetJobSpecResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let id = job_id(&request.into_inner().job_id)?;
        self.link.may_see(&by, id).await?;
        let spec = Some(self.link.spec(&account, id).await?);
        Ok(Response::new(wire::GetJobSpecResponse { spec }))
    }

    type WatchJobStream =
        Pin<Box<dyn Stream<Item = Result<wire::WatchJobResponse, Status>> + Send>>;

    async fn watch_job(
        &self,
        request: Request<wire::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let (caller, account) = (caller(&request), account(&request));
        let id = job_id(&request.into_inner().job_id)?;
        self.link.may_see(&caller, id).await?;
        // A missing job is an error at once, not in the stream.
        self.link.state(id).await?;
        let (sender, stream) = mpsc::channel(1);
        let link = self.link.clone();
        tokio::spawn(watch_while_allowed(link, caller, account, id, sender));
        // The response is charged until it is encoded, and as a part of the answer from then on.
        let stream = ReceiverStream::new(stream).map_ok(|(response, _charge)| response);
        Ok(Response::new(Box::pin(stream)))
    }

    async fn cancel_job(
        &self,
        request: Request<wire::CancelJobRequest>,
    ) -> Result<Response<wire::CancelJobResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let why = format!("by {}", by.name);
        let job = job_id(&request.into_inner().job_id)?;
        let cancel = |reply| Command::Cancel { job, why, reply };
        self.link.steer(&by, Act::Cancel, job, cancel).await?;
        Ok(Response::new(wire::CancelJobResponse {
            job: Some(self.link.status(&account, job).await?.into()),
        }))
    }

    async fn pause_job(
        &self,
        request: Request<wire::PauseJobRequest>,
    ) -> Result<Response<wire::PauseJobResponse>, Status> {
        let (who, account) = (caller(&request), account(&request));
        let job = job_id(&request.into_inner().job_id)?;
        Ok(Response::new(wire::PauseJobResponse {
            job: Some(self.pause(job, true, &who, &account).await?),
        }))
    }

    async fn resume_job(
        &self,
        request: Request<wire::ResumeJobRequest>,
    ) -> Result<Response<wire::ResumeJobResponse>, Status> {
        let (who, account) = (caller(&request), account(&request));
        let job = job_id(&request.into_inner().job_id)?;
        Ok(Response::new(wire::ResumeJobResponse {
            job: Some(self.pause(job, false, &who, &account).await?),
        }))
    }

    async fn drain_worker(
        &self,
        request: Request<wire::DrainWorkerRequest>,
    ) -> Result<Response<wire::DrainWorkerResponse>, Status> {
        let by = caller(&request);
        let worker = request.into_inner().worker;
        bounds::name(&worker, bounds::NAME_BYTES)
            .map_err(|what| Status::invalid_argument(format!("worker: {what}")))?;
        let asked = self.link.ask(|reply| Command::Drain(worker.clone(), reply));
        let answer = asked.await.and_then(|workers| match workers {
            0 => Err(Status::not_found(format!(
                "no worker of the name or id {worker:?} is connected to this coordinator; see `picofarm workers`"
            ))),
            workers => Ok(workers),
        });
        let done = format!("worker {worker:?}");
        self.link
            .audit
            .record(&by.name, Act::Drain, None, &answer, &done)
            .await;
        let workers = answer?;
        Ok(Response::new(wire::DrainWorkerResponse { workers }))
    }

    async fn retry_job(
        &self,
        request: Request<wire::RetryJobRequest>,
    ) -> Result<Response<wire::RetryJobResponse>, Status> {
        let by = caller(&request);
        let id = job_id(&request.into_inner().job_id)?;
        let retry = |reply| Command::Retry(id, reply);
        let retried = self.link.steer(&by, Act::Retry, id, retry).await?;
        if retried > 0 {
            self.link.submissions.learn(id).await.map_err(refused)?;
        }
        Ok(Response::new(wire::RetryJobResponse { retried }))
    }

    async fn list_events(
        &self,
        request: Request<wire::ListEventsRequest>,
    ) -> Result<Response<wire::ListEventsResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let request = request.into_inner();
        let job = match request.job_id.as_str() {
            "" => None,
            id => Some(job_id(id)?),
        };
        // A missing job is an error, not an empty history.
        let ended = match job {
            None => false,
            Some(job) => {
                self.link.may_see(&by, job).await?;
                self.link.state(job).await? != JobState::Active
            }
        };
        let query = EventQuery {
            job,
            after: request.after,
            limit: match request.limit {
                0 => EVENTS,
                n => n.min(EVENTS),
            },
            task: request.task,
            stage: request.stage,
            newest: request.newest,
            logs: request.logs,
            sight: by.sight(self.link.visibility),
        };
        let charge = account.charge("the history", LINE * u64::from(query.limit));
        let _charge = charge.await?;
        let events = self
            .link
            .read(move |catalog| async move { catalog.events(&query).await })
            .await?;
        Ok(Response::new(wire::ListEventsResponse {
            events: events.into_iter().map(Into::into).collect(),
            ended,
        }))
    }

    async fn explain_job(
        &self,
        request: Request<wire::ExplainJobRequest>,
    ) -> Result<Response<wire::ExplainJobResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let request = request.into_inner();
        let job = job_id(&request.job_id)?;
        self.link.may_see(&by, job).await?;
        let explained = look::explain(
            &self.link,
            (&by, &account),
            job,
            request.stage,
            request.task,
        )
        .await?;
        Ok(Response::new(explained))
    }

    async fn list_workers(
        &self,
        request: Request<wire::ListWorkersRequest>,
    ) -> Result<Response<wire::ListWorkersResponse>, Status> {
        let workers = self.link.ask(Command::Workers).await?;
        let charge = account(&request)
            .charge("the list", WORKER * u64::from(workers))
            .await?;
        let look = self.link.ask(Command::FarmSnapshot).await?;
        let answer = Response::new(wire::ListWorkersResponse {
            coordinator: self.link.name.to_string(),
            workers: look.workers.into_iter().map(Into::into).collect(),
            elsewhere: look.elsewhere,
            coordinators: look.instances,
        });
        drop(charge);
        Ok(answer)
    }

    async fn get_demand(
        &self,
        request: Request<wire::GetDemandRequest>,
    ) -> Result<Response<wire::GetDemandResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let worker = request.into_inner().worker;
        let worker = worker.ok_or_else(|| invalid(ConvertError::Missing { field: "worker" }))?;
        let workers = self.link.ask(Command::Workers).await?;
        let _charge = account
            .charge("the demand", WORKER * u64::from(workers))
            .await?;
        let worker = worker.try_into().map_err(invalid)?;
        Ok(Response::new(look::demand(&self.link, &by, worker).await?))
    }

    async fn examine_workers(
        &self,
        request: Request<wire::ExamineWorkersRequest>,
    ) -> Result<Response<wire::ExamineWorkersResponse>, Status> {
        let account = account(&request);
        let answer = examine(&self.link, &account, request.into_inner());
        Ok(Response::new(answer.await?))
    }

    async fn get_usage(
        &self,
        request: Request<wire::GetUsageRequest>,
    ) -> Result<Response<wire::GetUsageResponse>, Status> {
        let (by, account) = (caller(&request), account(&request));
        let query = usage(&request.into_inner(), by.sight(self.link.visibility))?;
        let charge = account.charge("the usage", LINE * u64::from(EVENTS));
        let _charge = charge.await?;
        let rows = self
            .link
            .read(move |catalog| async move { catalog.usage(&query).await })
            .await?;
        Ok(Response::new(wire::GetUsageResponse {
            rows: rows.into_iter().map(Into::into).collect(),
        }))
    }

    async fn list_audit(
        &self,
        request: Request<wire::ListAuditRequest>,
    ) -> Result<Response<wire::ListAuditResponse>, Status> {
        let account = account(&request);
        let request = request.into_inner();
        let query = AuditQuery {
            before: (request.before > 0).then_some(request.before),
            limit: match request.limit {
                0 => EVENTS,
                n => n.min(EVENTS),
            },
            who: filter(request.who, "who")?,
            job: match request.job_id.as_str() {
                "" => None,
                id => Some(job_id(id)?),
            },
        };
        let charge = account.charge("the log", LINE * u64::from(query.limit));
        let _charge = charge.await?;
        let lines = self
            .link
            .read(move |catalog| async move { catalog.audited(&query).await })
            .await?;
        Ok(Response::new(wire::ListAuditResponse {
            entries: lines.into_iter().map(Into::into).collect(),
        }))
    }
}
