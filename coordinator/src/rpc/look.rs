//! Gathering the facts for an explanation.

use picofarm_catalog::{CatalogError, EventQuery, ResultSet};
use picofarm_proto::{
    ids::{JobId, StageRef},
    model::Event,
    wire,
};
use tonic::Status;

use super::Link;
use crate::{
    actor::Command,
    core::JobLook,
    explain::{self, JobFacts, TaskFacts},
};

/// Lines of a task's history in an answer.
const EVENTS: u32 = 1_000;
/// Other jobs whose history is searched for the maker of a result.
const OTHERS: usize = 20;

fn failed(error: CatalogError) -> Status {
    Status::unavailable(error.to_string())
}

/// Why a job does not run; and what became of one task, where one is named.
///
/// # Errors
/// NOT_FOUND for a job or task that there is not; UNAVAILABLE where the catalog is out of order.
pub(super) async fn explain(
    link: &Link,
    job: JobId,
    stage: u32,
    task: Option<u64>,
) -> Result<wire::ExplainJobResponse, Status> {
    let status = link.ask(|reply| Command::Get(job, reply)).await?;
    let Some(of) = status.stages.get(stage as usize) else {
        return Err(Status::not_found(format!(
            "job {job} has no stage {stage}: its {} stages count from 0",
            status.stages.len()
        )));
    };
    if let Some(task) = task.filter(|task| *task >= of.tasks.total) {
        return Err(Status::not_found(format!(
            "stage {:?} of job {job} has no task {task}: its {} tasks count from 0",
            of.name, of.tasks.total
        )));
    }
    let look = link
        .ask(|reply| Command::LookAt {
            job,
            stage: task.map(|_| stage),
            task,
            reply,
        })
        .await?;
    let here = StageRef { job, stage };
    let now_ms = link.clock.now_ms();
    let JobLook {
        candidates,
        ahead,
        elsewhere,
        running,
    } = look;
    let reasons = explain::job(&JobFacts {
        job,
        state: status.state,
        paused: status.paused,
        stages: status.stages.clone(),
        counts: status.tasks,
        holdups: link.catalog.holdups(job, now_ms).await.map_err(failed)?,
        candidates,
        ahead,
        elsewhere,
        now_ms,
    });
    let told = match task {
        None => None,
        Some(index) => {
            let events = history(link, here, index).await?;
            let record = link.catalog.task(here, index).await.map_err(failed)?;
            let made_here = events.iter().any(explain::committed);
            let elsewhere = match &record.output {
                Some(_) if !made_here => maker(link, here, index).await?,
                _ => None,
            };
            Some(explain::task(TaskFacts {
                index,
                job,
                record,
                events,
                limits: status.spec.limits.clone(),
                elsewhere,
                running,
                now_ms,
            }))
        }
    };
    Ok(wire::ExplainJobResponse {
        job: Some(status.into()),
        reasons: reasons.into_iter().map(Into::into).collect(),
        task: told.map(Into::into),
    })
}

/// The history of a task: its last lines.
async fn history(link: &Link, stage: StageRef, task: u64) -> Result<Vec<Event>, Status> {
    let query = EventQuery {
        job: Some(stage.job),
        stage: Some(stage.stage),
        after: 0,
        limit: EVENTS,
        task: Some(task),
        newest: true,
        logs: false,
    };
    link.catalog.events(&query).await.map_err(failed)
}

/// The job with the same results under which a task was handed in, and the line that says so.
async fn maker(
    link: &Link,
    stage: StageRef,
    task: u64,
) -> Result<Option<(JobId, String, Event)>, Status> {
    let Some(record) = link.catalog.job(stage.job).await.map_err(failed)? else {
        return Ok(None);
    };
    let Some(spec) = record.job.spec.stages.get(stage.stage as usize) else {
        return Ok(None);
    };
    let set = ResultSet::of(spec);
    let others = link
        .catalog
        .jobs_at(&set.store, &set.dataset)
        .await
        .map_err(failed)?;
    for other in others.iter().filter(|o| o.id != stage.job).take(OTHERS) {
        for theirs in other.stages().into_iter().filter(|s| s.set == set) {
            let events = history(link, theirs.id, task).await?;
            if let Some(event) = events.into_iter().find(explain::committed) {
                return Ok(Some((other.id, other.spec.name.clone(), event)));
            }
        }
    }
    Ok(None)
}
