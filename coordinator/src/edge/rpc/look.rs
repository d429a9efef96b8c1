//! Collects the facts for an explanation.

use std::collections::BTreeSet;

use picofarm_catalog::{EventQuery, Owner, ResultSet, Sight};
use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::{Event, EventKind, WorkerHello},
    wire,
};
use tonic::Status;

use super::link::Link;
use crate::{
    actor::Command,
    auth::Caller,
    core::{JobSnapshot, Shape},
    explain::{self, JobFacts, TaskFacts},
    memory::Account,
};

/// Lines of a task's history in an answer.
const EVENTS: u32 = 1_000;
/// Most other jobs searched for the origin of a result.
const OTHERS: usize = 20;

/// Explains why a job does not run, and the history of one task if one is named.
///
/// # Errors
/// Returns NOT_FOUND for a missing job or task, or UNAVAILABLE if the catalog fails.
pub(super) async fn explain(
    link: &Link,
    (by, account): (&Caller, &Account),
    job: JobId,
    stage: u32,
    task: Option<u64>,
) -> Result<wire::ExplainJobResponse, Status> {
    let status = link.status(account, job).await?;
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
        .ask(|reply| Command::JobSnapshot {
            job,
            stage: task.map(|_| stage),
            task,
            reply,
        })
        .await?;
    let here = StageRef { job, stage };
    let sight = by.sight(link.visibility);
    let now_ms = link.clock.now_ms();
    let JobSnapshot {
        candidates,
        shared,
        suspects,
        ahead,
        elsewhere,
        running,
        pools,
        over_bytes,
    } = look;
    let (ahead, unseen) = seen(link, &sight, ahead).await?;
    let reasons = explain::job(&JobFacts {
        job,
        state: status.state,
        paused: status.paused,
        stages: status.stages.clone(),
        counts: status.tasks,
        holdups: link
            .read(move |catalog| async move { catalog.holdups(job, now_ms).await })
            .await?,
        candidates,
        shared,
        suspects,
        deadline: status.passed_deadline().map(str::to_owned),
        ahead,
        unseen,
        elsewhere,
        pools,
        over_bytes,
        running: status.running.clone(),
        setback: setback(link, job).await?,
        now_ms,
    });
    let explained = match task {
        None => None,
        Some(index) => {
            let events = history(link, here, index).await?;
            let record = link
                .read(move |catalog| async move { catalog.task(here, index).await })
                .await?;
            let made_here = events.iter().any(explain::committed);
            let elsewhere = match &record.output {
                Some(_) if !made_here => maker(link, &sight, here, index).await?,
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
        task: explained.map(Into::into),
        may_change: link.has_right(by, job).await?,
    })
}

/// Returns the tasks that wait for workers of one shape. Jobs that the caller may not see have
/// neither ids nor names.
///
/// # Errors
/// Returns UNAVAILABLE if the catalog fails.
pub(super) async fn demand(
    link: &Link,
    by: &Caller,
    worker: WorkerHello,
) -> Result<wire::GetDemandResponse, Status> {
    let shape = Shape {
        pool: worker.name,
        abilities: worker.abilities,
        lasts_ms: worker.ends_in_ms,
    };
    let demand = link
        .ask(|reply| Command::Demand(Box::new(shape), reply))
        .await?;
    let sight = by.sight(link.visibility);
    let jobs: BTreeSet<JobId> = demand.stages.iter().map(|stage| stage.job).collect();
    let (seen, _) = seen(link, &sight, jobs.into_iter().collect()).await?;
    let mut stages = Vec::new();
    for stage in demand.stages {
        let seen = seen.contains(&stage.job);
        if stage.refused.is_some() && !seen {
            continue;
        }
        stages.push(wire::StageDemand {
            job_id: if seen {
                stage.job.to_string()
            } else {
                String::new()
            },
            stage: if seen { stage.stage } else { String::new() },
            tasks: stage.tasks,
            task_seconds: stage.task_seconds,
            idle: stage.idle,
            room: stage.room.map(|n| u32::try_from(n).unwrap_or(u32::MAX)),
            refused: stage.refused.unwrap_or_default(),
        });
    }
    let workers = demand.workers.into_iter();
    Ok(wire::GetDemandResponse {
        stages,
        workers: workers
            .map(|(name, tasks)| wire::PoolWorker { name, tasks })
            .collect(),
        unknown: demand.unknown,
    })
}

/// Returns the visible jobs among these, and the number of the others.
async fn seen(link: &Link, sight: &Sight, jobs: Vec<JobId>) -> Result<(Vec<JobId>, u64), Status> {
    if *sight == Sight::All {
        return Ok((jobs, 0));
    }
    let (mut seen, mut unseen) = (Vec::new(), 0);
    for job in jobs {
        match link
            .read(move |catalog| async move { catalog.owner(job).await })
            .await?
        {
            Some(owner) if sight.sees(&owner) => seen.push(job),
            _ => unseen += 1,
        }
    }
    Ok((seen, unseen))
}

/// Returns the last line of a job's recent history that explains an interrupted task, if any.
async fn setback(link: &Link, job: JobId) -> Result<Option<Event>, Status> {
    const LATEST: u32 = 200;
    let query = EventQuery {
        job: Some(job),
        stage: None,
        after: 0,
        limit: LATEST,
        task: None,
        newest: true,
        sight: Sight::All,
        logs: false,
    };
    let events = link
        .read(move |catalog| async move { catalog.events(&query).await })
        .await?;
    let against = |event: &Event| {
        matches!(
            event.kind,
            EventKind::Failed | EventKind::Released | EventKind::Expired
        )
    };
    Ok(events.into_iter().rfind(against))
}

/// Returns the last lines of a task's history.
async fn history(link: &Link, stage: StageRef, task: u64) -> Result<Vec<Event>, Status> {
    let query = EventQuery {
        job: Some(stage.job),
        stage: Some(stage.stage),
        after: 0,
        limit: EVENTS,
        task: Some(task),
        newest: true,
        logs: false,
        // The caller may see the job, which was checked before.
        sight: Sight::All,
    };
    link.read(move |catalog| async move { catalog.events(&query).await })
        .await
}

/// Returns the job with the same results under which a task was reported, with that history line.
async fn maker(
    link: &Link,
    sight: &Sight,
    stage: StageRef,
    task: u64,
) -> Result<Option<(JobId, String, Event)>, Status> {
    let sight = sight.clone();
    let alike = link.read(move |catalog| async move {
        let Some(record) = catalog.job(stage.job).await? else {
            return Ok(Vec::new());
        };
        let Some(spec) = record.job.spec.stages.get(stage.stage as usize) else {
            return Ok(Vec::new());
        };
        let set = ResultSet::of_stage(spec);
        let others = catalog.jobs_at(&set.store, &set.dataset).await?;
        let others = others.into_iter().filter(|o| sight.sees(&Owner::from(o)));
        let mut alike = Vec::new();
        for other in others.filter(|o| o.id != stage.job).take(OTHERS) {
            let stages = other.stages().into_iter();
            let same = stages.filter(|s| s.set == set).map(|s| s.id);
            alike.extend(same.map(|id| (id, other.spec.name.clone())));
        }
        Ok(alike)
    });
    for (theirs, name) in alike.await? {
        let events = history(link, theirs, task).await?;
        if let Some(event) = events.into_iter().find(explain::committed) {
            return Ok(Some((theirs.job, name, event)));
        }
    }
    Ok(None)
}
