//! Handles the commands of one batch.

use std::collections::HashMap;

use picofarm_catalog::CatalogError;
use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::{FailureKind, JobState},
};

use super::{Life, reports::KnownManifests};
use crate::{
    actor::command::{Command, FromWorker, Refusal, Reply, Ruling},
    core::{Reported, SessionId},
};

impl Life<'_> {
    pub(super) async fn handle(&mut self, batch: &mut Vec<Command>) -> Result<(), CatalogError> {
        // The recorded results of all reported tasks are fetched with one query.
        let reports = batch.iter().flat_map(|command| match command {
            Command::Worker(_, FromWorker::Done(report)) | Command::Judged(_, report, _) => {
                vec![report]
            }
            Command::Verified { reports, .. } => reports
                .iter()
                .map(|(reported, _)| &reported.report)
                .collect(),
            _ => Vec::new(),
        });
        let asked: Vec<(StageRef, u64)> = reports
            .filter_map(|report| Some((self.core.stage_of(report)?, report.index)))
            .collect();
        let mut new: HashMap<String, Vec<Reported>> = HashMap::new();
        let found = self.actor.catalog.manifests(&asked).await?;
        let known: KnownManifests = asked.into_iter().zip(found).collect();
        for command in batch.drain(..) {
            match command {
                Command::Open {
                    session,
                    hello,
                    say,
                    waiting,
                    here,
                } => {
                    // The worker keeps its leases, whichever coordinator granted them.
                    self.flush().await?;
                    let owned = self.actor.catalog.adopt(hello.id).await?;
                    let now = self.now();
                    self.core.receive(owned, now);
                    self.sessions.open(session, say, waiting);
                    self.core.hello(session, hello, now);
                    self.core.set_local(session, here);
                }
                Command::Worker(session, FromWorker::Done(report)) => {
                    let checks = self.actor.slow_work.can_check_stores();
                    match self.core.reported(session, &report).filter(|_| checks) {
                        _ if self.disputed(session, &report, &known) => {}
                        Some(reported) => {
                            let reports = new.entry(reported.store.clone()).or_default();
                            reports.push(reported);
                        }
                        None => self.done(session, &report, &known, false),
                    }
                }
                Command::Verified {
                    store,
                    reports,
                    blind,
                } => {
                    self.verified(&store, reports, blind, &known);
                }
                Command::Judged(session, report, ruling) => {
                    self.disputes = self.disputes.saturating_sub(1);
                    match ruling {
                        Ruling::Unknown if self.outvoted(session, &report, &known) => {}
                        Ruling::Overruled(note) => {
                            self.core.overruled(session, &report, note, self.now());
                            self.done(session, &report, &known, false);
                        }
                        Ruling::Stands | Ruling::Unknown => {
                            self.done(session, &report, &known, false);
                        }
                    }
                }
                Command::Worker(session, said) => self.worker_said(session, said),
                Command::Broken(error) => return Err(error),
                Command::Learn(new_job, reply) => {
                    if let Some(new_job) = new_job {
                        self.learn(*new_job);
                    }
                    self.actor.revision.send_modify(|n| *n += 1);
                    let _ = reply.send(Ok(()));
                }
                Command::Overlay(one, reply) => {
                    let _ = reply.send(Ok(self.core.overlay(one, self.now())));
                }
                Command::Cancel { job, why, reply } => {
                    self.flush().await?;
                    let cancelled = self.cancel(job, &why).await;
                    answer(reply, cancelled.map(Ok))?;
                }
                Command::Pause {
                    job,
                    paused,
                    who,
                    reply,
                } => {
                    self.flush().await?;
                    answer(reply, self.pause(job, paused, &who).await)?;
                }
                Command::Retry(id, reply) => {
                    self.flush().await?;
                    answer(reply, self.retry(id).await)?;
                }
                Command::Workers(reply) => {
                    let _ = reply.send(Ok(self.core.everywhere()));
                }
                Command::EligibleWorkers(spec, reply) => {
                    let _ = reply.send(Ok(self.core.eligible_workers(&spec, self.now())));
                }
                Command::FarmSnapshot(reply) => {
                    let _ = reply.send(Ok(self.core.farm_snapshot(self.now())));
                }
                Command::Forecasts(reply) => {
                    let _ = reply.send(Ok(self.core.forecasts()));
                }
                Command::Demand(shape, reply) => {
                    let now = self.now();
                    self.core.pool_asks(&shape, now);
                    let _ = reply.send(Ok(self.core.demand(&shape, now)));
                }
                Command::JobSnapshot {
                    job,
                    stage,
                    task,
                    reply,
                } => {
                    let look = self.core.job_snapshot(job, stage, task, self.now());
                    let _ = reply.send(Ok(look));
                }
                Command::Examine(what, reply) => {
                    let _ = reply.send(Ok(self.core.examine(&what)));
                }
                Command::Drain(worker, reply) => {
                    let _ = reply.send(Ok(self.core.drain(&worker)));
                }
            }
        }
        for (store, reports) in new {
            self.start_check(store, reports);
        }
        Ok(())
    }

    fn worker_said(&mut self, session: SessionId, said: FromWorker) {
        let now = self.now();
        match said {
            FromWorker::Credit(n) => self.core.credit(session, n),
            FromWorker::Heartbeat(leases, progress, ends_in_ms) => {
                self.sessions.heartbeat_handled(session);
                self.core.ends(session, ends_in_ms, now);
                self.core.heartbeat(session, &leases, &progress, now);
            }
            FromWorker::Done(_) => unreachable!("handled with what the catalog holds"),
            FromWorker::Unusable(lease, index, why) => {
                let before = self.core.new_events();
                self.core.unusable(session, lease, index, &why, now);
                if self.core.new_events() > before {
                    self.tally.failed(FailureKind::User);
                }
            }
            FromWorker::Failed(failure) => {
                let before = self.core.new_events();
                self.core.failed(session, &failure, now);
                // A refused report adds no line to the history.
                if self.core.new_events() > before {
                    self.tally.failed(failure.kind);
                }
            }
            FromWorker::Release(lease, reason) => self.core.released(session, lease, &reason, now),
            FromWorker::Log(log) => self.core.logged(session, &log, now),
            FromWorker::Closed => {
                self.sessions.close(session);
                self.core.closed(session, now);
                self.core.set_local(session, false);
            }
        }
    }

    /// Cancels a job, if it is active.
    pub(super) async fn cancel(&mut self, job: JobId, why: &str) -> Result<(), CatalogError> {
        let catalog = &self.actor.catalog;
        if catalog.state(job).await?.is_some() && catalog.cancel(job, why, self.now()).await? {
            self.core.drop_job(job, "the job was cancelled");
            self.flush().await?;
            // Watchers are notified even if this instance has no tasks of the job.
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(())
    }

    async fn pause(
        &mut self,
        job: JobId,
        paused: bool,
        who: &str,
    ) -> Result<Result<(), Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        match catalog.state(job).await? {
            None => return Ok(Err(Refusal::NoSuchJob(job))),
            Some(JobState::Active) => {}
            Some(_) => return Ok(Err(Refusal::NotNow(format!("job {job} has ended")))),
        }
        if catalog.pause(job, paused, who, self.now()).await? {
            self.core.paused(job, paused);
            self.flush().await?;
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(Ok(()))
    }

    async fn retry(&mut self, id: JobId) -> Result<Result<u64, Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        let Some(state) = catalog.state(id).await? else {
            return Ok(Err(Refusal::NoSuchJob(id)));
        };
        if state == JobState::Cancelled {
            return Ok(Err(Refusal::NotNow(format!(
                "job {id} was cancelled; submit its file with --again instead (finished tasks are reused)"
            ))));
        }
        let retried = match catalog.retry(id, self.now()).await {
            Ok(retried) => retried,
            Err(CatalogError::Conflict(why)) => return Ok(Err(Refusal::NotNow(why))),
            Err(error) => return Err(error),
        };
        if retried > 0 {
            self.core.retried(id);
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(Ok(retried))
    }
}

/// Answers a request. If the catalog rejects the request's content, the error goes to the client
/// and the life continues. Any other failure of the catalog is logged and ends this life.
fn answer<T>(
    reply: Reply<T>,
    found: Result<Result<T, Refusal>, CatalogError>,
) -> Result<(), CatalogError> {
    let (answer, end) = match found {
        Ok(answer) => (answer, Ok(())),
        Err(CatalogError::Refused { what, .. }) => (Err(Refusal::Content(what)), Ok(())),
        Err(error) => (Err(Refusal::Catalog(error.to_string())), Err(error)),
    };
    // The client may have stopped waiting.
    let _ = reply.send(answer);
    end
}
