//! Service `Jobs`: what clients ask.

use std::{pin::Pin, time::Duration};

use futures::Stream;
use picofarm_catalog::EventQuery;
use picofarm_proto::{
    PROTOCOL,
    convert::ConvertError,
    ids::JobId,
    model::{JobSpec, JobState, StageSpec},
    wire::{self, jobs_server::Jobs},
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::{Link, caller, invalid, look};
use crate::{
    VERSION,
    actor::Command,
    auth::{Caller, Quotas},
    plan,
};

/// Least time between two reports to a watcher.
const DEBOUNCE: Duration = Duration::from_millis(250);
/// Events in one answer where the client names no limit, and at most.
const EVENTS: u32 = 1_000;
const MOST_EVENTS: u32 = 10_000;

pub(crate) struct JobsService {
    link: Link,
    quotas: Quotas,
}

impl JobsService {
    pub(crate) fn new(link: Link, quotas: Quotas) -> Self {
        Self { link, quotas }
    }

    fn spec(&self, wire: Option<wire::JobSpec>) -> Result<Box<JobSpec>, Status> {
        let wire = wire.ok_or_else(|| invalid(ConvertError::Missing { field: "spec" }))?;
        let spec = JobSpec::try_from(wire).map_err(invalid)?;
        spec.check().map_err(|e| invalid(e.into()))?;
        plan::check_resolved(&spec).map_err(|e| invalid(e.into()))?;
        spec.check_places().map_err(|e| invalid(e.into()))?;
        let tasks: u64 = spec.stages.iter().map(StageSpec::tasks).sum();
        let most = self.quotas.tasks_per_job;
        if tasks > most {
            return Err(Status::resource_exhausted(format!(
                "the job's {tasks} tasks are more than the {most} that --max-tasks-per-job allows; split the job"
            )));
        }
        Ok(Box::new(spec))
    }
}

impl JobsService {
    async fn pause(
        &self,
        job: JobId,
        paused: bool,
        who: &Caller,
    ) -> Result<wire::JobStatus, Status> {
        let pause = |reply| Command::Pause {
            job,
            paused,
            who: format!("by {}", who.name),
            reply,
        };
        Ok(self.link.ask(pause).await?.into())
    }
}

fn job_id(text: &str) -> Result<JobId, Status> {
    text.parse()
        .map_err(|e| Status::invalid_argument(format!("job_id: {e}")))
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
        let spec = self.spec(request.into_inner().spec)?;
        let plan = self.link.ask(|reply| Command::Plan(spec, reply)).await?;
        Ok(Response::new(wire::PlanJobResponse {
            plan: Some(plan.into()),
        }))
    }

    async fn submit_job(
        &self,
        request: Request<wire::SubmitJobRequest>,
    ) -> Result<Response<wire::SubmitJobResponse>, Status> {
        let caller = caller(&request);
        let request = request.into_inner();
        let spec = self.spec(request.spec)?;
        let submitted = self
            .link
            .ask(|reply| Command::Submit {
                spec,
                user: caller.name.to_string(),
                most: self.quotas.jobs_per_user as u64,
                again: request.again,
                reply,
            })
            .await?;
        Ok(Response::new(wire::SubmitJobResponse {
            job_id: submitted.job.to_string(),
            existed: submitted.existed,
            plan: Some(submitted.plan.into()),
        }))
    }

    async fn list_jobs(
        &self,
        _: Request<wire::ListJobsRequest>,
    ) -> Result<Response<wire::ListJobsResponse>, Status> {
        let jobs = self.link.ask(Command::List).await?;
        Ok(Response::new(wire::ListJobsResponse {
            jobs: jobs.into_iter().map(Into::into).collect(),
        }))
    }

    async fn get_job(
        &self,
        request: Request<wire::GetJobRequest>,
    ) -> Result<Response<wire::GetJobResponse>, Status> {
        let id = job_id(&request.into_inner().job_id)?;
        let job = self.link.ask(|reply| Command::Get(id, reply)).await?;
        Ok(Response::new(wire::GetJobResponse {
            job: Some(job.into()),
        }))
    }

    type WatchJobStream =
        Pin<Box<dyn Stream<Item = Result<wire::WatchJobResponse, Status>> + Send>>;

    async fn watch_job(
        &self,
        request: Request<wire::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let caller = caller(&request);
        let id = job_id(&request.into_inner().job_id)?;
        // A job that does not exist is an error now, not in the stream.
        self.link.ask(|reply| Command::Get(id, reply)).await?;
        let (sender, stream) = mpsc::channel(4);
        tokio::spawn(watch_while_allowed(self.link.clone(), caller, id, sender));
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }

    async fn cancel_job(
        &self,
        request: Request<wire::CancelJobRequest>,
    ) -> Result<Response<wire::CancelJobResponse>, Status> {
        let why = format!("by {}", caller(&request).name);
        let job = job_id(&request.into_inner().job_id)?;
        let cancel = |reply| Command::Cancel { job, why, reply };
        let job = self.link.ask(cancel).await?;
        Ok(Response::new(wire::CancelJobResponse {
            job: Some(job.into()),
        }))
    }

    async fn pause_job(
        &self,
        request: Request<wire::PauseJobRequest>,
    ) -> Result<Response<wire::PauseJobResponse>, Status> {
        let who = caller(&request);
        let job = job_id(&request.into_inner().job_id)?;
        Ok(Response::new(wire::PauseJobResponse {
            job: Some(self.pause(job, true, &who).await?),
        }))
    }

    async fn resume_job(
        &self,
        request: Request<wire::ResumeJobRequest>,
    ) -> Result<Response<wire::ResumeJobResponse>, Status> {
        let who = caller(&request);
        let job = job_id(&request.into_inner().job_id)?;
        Ok(Response::new(wire::ResumeJobResponse {
            job: Some(self.pause(job, false, &who).await?),
        }))
    }

    async fn drain_worker(
        &self,
        request: Request<wire::DrainWorkerRequest>,
    ) -> Result<Response<wire::DrainWorkerResponse>, Status> {
        let worker = request.into_inner().worker;
        let workers = self
            .link
            .ask(|reply| Command::Drain(worker.clone(), reply))
            .await?;
        if workers == 0 {
            return Err(Status::not_found(format!(
                "no worker of the name or id {worker:?} is connected to this coordinator; see `picofarm workers`"
            )));
        }
        Ok(Response::new(wire::DrainWorkerResponse { workers }))
    }

    async fn retry_job(
        &self,
        request: Request<wire::RetryJobRequest>,
    ) -> Result<Response<wire::RetryJobResponse>, Status> {
        let id = job_id(&request.into_inner().job_id)?;
        let retried = self.link.ask(|reply| Command::Retry(id, reply)).await?;
        Ok(Response::new(wire::RetryJobResponse { retried }))
    }

    async fn list_events(
        &self,
        request: Request<wire::ListEventsRequest>,
    ) -> Result<Response<wire::ListEventsResponse>, Status> {
        let request = request.into_inner();
        let job = match request.job_id.as_str() {
            "" => None,
            id => Some(job_id(id)?),
        };
        // A job that does not exist is an error, not an empty history.
        let ended = match job {
            None => false,
            Some(job) => {
                let status = self.link.ask(|reply| Command::Get(job, reply)).await?;
                status.state != JobState::Active
            }
        };
        let query = EventQuery {
            job,
            after: request.after,
            limit: match request.limit {
                0 => EVENTS,
                n => n.min(MOST_EVENTS),
            },
            task: request.task,
            stage: request.stage,
            newest: request.newest,
            logs: request.logs,
        };
        let events = self.link.catalog.events(&query).await;
        let events = events.map_err(|e| Status::unavailable(e.to_string()))?;
        Ok(Response::new(wire::ListEventsResponse {
            events: events.into_iter().map(Into::into).collect(),
            ended,
        }))
    }

    async fn explain_job(
        &self,
        request: Request<wire::ExplainJobRequest>,
    ) -> Result<Response<wire::ExplainJobResponse>, Status> {
        let request = request.into_inner();
        let job = job_id(&request.job_id)?;
        let explained = look::explain(&self.link, job, request.stage, request.task).await?;
        Ok(Response::new(explained))
    }

    async fn list_workers(
        &self,
        _: Request<wire::ListWorkersRequest>,
    ) -> Result<Response<wire::ListWorkersResponse>, Status> {
        let look = self.link.ask(Command::Look).await?;
        Ok(Response::new(wire::ListWorkersResponse {
            coordinator: self.link.name.to_string(),
            workers: look.workers.into_iter().map(Into::into).collect(),
            elsewhere: look.elsewhere,
            coordinators: look.houses,
        }))
    }
}

/// Watches until the caller's token is revoked.
async fn watch_while_allowed(
    link: Link,
    caller: Caller,
    id: JobId,
    sender: mpsc::Sender<Result<wire::WatchJobResponse, Status>>,
) {
    let revoked = tokio::select! {
        () = watch(link, id, sender.clone()) => return,
        status = caller.revoked() => status,
    };
    let _ = sender.send(Err(revoked)).await;
}

/// Reports at once and after each change, until the job ends or nobody listens.
async fn watch(
    mut link: Link,
    id: JobId,
    sender: mpsc::Sender<Result<wire::WatchJobResponse, Status>>,
) {
    let mut last = None;
    loop {
        link.revision.mark_unchanged();
        let status = match link.ask(|reply| Command::Get(id, reply)).await {
            Ok(status) => status,
            Err(error) => {
                let _ = sender.send(Err(error)).await;
                return;
            }
        };
        let over = status.state != JobState::Active;
        if last.as_ref() != Some(&status) {
            let job = Some(status.clone().into());
            if sender
                .send(Ok(wire::WatchJobResponse { job }))
                .await
                .is_err()
            {
                return;
            }
            last = Some(status);
        }
        if over {
            return;
        }
        tokio::select! {
            () = tokio::time::sleep(DEBOUNCE) => {}
            () = sender.closed() => return,
            () = link.stop.cancelled() => return,
        }
        tokio::select! {
            changed = link.revision.changed() => if changed.is_err() { return },
            () = sender.closed() => return,
            () = link.stop.cancelled() => return,
        }
    }
}
