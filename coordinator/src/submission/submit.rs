//! Plans a draft, or records it as a job.

use std::sync::Arc;

use picofarm_catalog::{Gone, Outcome, OwnedPlace, Owner, Run, Sight, Submission, published};
use picofarm_proto::{
    ids::JobId,
    messages::{JobPlan, JobState},
    spec::SpecError,
};
use uuid::Uuid;

use super::{
    consider::Considered,
    draft::Draft,
    places,
    prepare::{Prepared, prepare, reuses_job},
    service::{Submissions, broken},
};
use crate::{
    actor::{Refusal, Submitted},
    auth::{Caller, not_owner},
    core::over_bytes,
};

/// A caller's limits on its jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct UserLimits {
    /// Unfinished jobs.
    pub jobs: u64,
    /// Bytes that the jobs publish, over all time; `None` for no bound.
    pub bytes: Option<u64>,
}

/// Most attempts to plan a submission again because the catalog changed meanwhile.
const ATTEMPTS: usize = 4;

impl Submissions {
    /// Returns what submitting the draft would do.
    pub(crate) async fn plan(&self, draft: &Arc<Draft>, by: &Caller) -> Result<JobPlan, Refusal> {
        self.in_time(draft)?;
        self.after_known_jobs(draft, by).await?;
        Ok(self.consider(draft, by).await?.plan)
    }

    /// Refuses a job that waits for one that does not exist, or that the caller may not see.
    async fn after_known_jobs(&self, draft: &Draft, by: &Caller) -> Result<Vec<JobId>, Refusal> {
        let after = draft.spec.after_jobs().map_err(Refusal::Spec)?;
        let sight = by.sight(self.visibility);
        for job in &after {
            let owner = self.catalog.owner(*job).await.map_err(broken)?;
            if !owner.is_some_and(|owner| sight.sees(&owner)) {
                let what = format!("there is no job {job}; see `picofarm job list`");
                return Err(Refusal::Spec(SpecError::new("after", what)));
            }
        }
        Ok(after)
    }

    /// Refuses a deadline that has passed, because the job would be cancelled at once.
    fn in_time(&self, draft: &Draft) -> Result<(), Refusal> {
        let limits = &draft.spec.limits;
        let deadline = limits.deadline_ms().map_err(Refusal::Spec)?;
        if deadline.is_some_and(|at| at <= self.clock.now_ms()) {
            let what = format!(
                "{:?} is in the past, so the job would be cancelled at once; give a later time, or remove it",
                limits.deadline
            );
            return Err(Refusal::Spec(SpecError::new("limits.deadline", what)));
        }
        Ok(())
    }

    /// Records a job, unless an existing one is reused.
    pub(crate) async fn submit(
        &self,
        draft: &Arc<Draft>,
        by: &Caller,
        most: UserLimits,
        again: bool,
    ) -> Result<Submitted, Refusal> {
        self.in_time(draft)?;
        for _ in 0..ATTEMPTS {
            let after = self.after_known_jobs(draft, by).await?;
            let considered = self.consider(draft, by).await?;
            let latest = considered.latest.as_ref();
            let stands = latest.filter(|job| !considered.lost && reuses_job(job.state, again));
            if let Some(job) = stands {
                return Ok(Submitted {
                    job: job.id,
                    existed: true,
                    plan: considered.plan,
                });
            }
            // The job failed or was cancelled, and is requested again.
            if let Some(job) = latest.filter(|job| job.state != JobState::Done)
                && !by.may_change(&job.owner)
            {
                return Err(Refusal::Denied(not_owner(&job.id, &job.owner)));
            }
            if let Some(submitted) = self.record(draft, by, most, (considered, after)).await? {
                return Ok(submitted);
            }
        }
        Err(Refusal::NotNow(
            "what the job would reuse, or the same job of someone else, kept changing; try again"
                .into(),
        ))
    }

    /// Checks a caller's limits before another job of it is recorded.
    async fn within(&self, user: &str, most: UserLimits) -> Result<(), Refusal> {
        if self.catalog.unfinished_jobs(user).await.map_err(broken)? >= most.jobs {
            return Err(Refusal::TooMany(format!(
                "{user:?} has {} jobs that have not ended, the most that --max-jobs-per-user allows; wait for some to end, or \
                 cancel some",
                most.jobs
            )));
        }
        if let Some(most) = most.bytes {
            let published = published(&*self.catalog, Sight::All)
                .await
                .map_err(broken)?;
            let used = published.get(user).copied().unwrap_or(0);
            if used >= most {
                return Err(Refusal::TooMany(over_bytes(user, used, most)));
            }
        }
        Ok(())
    }

    /// Records the job. Returns `None` if the catalog has changed since the job was considered.
    async fn record(
        &self,
        draft: &Arc<Draft>,
        by: &Caller,
        most: UserLimits,
        (considered, after): (Considered, Vec<JobId>),
    ) -> Result<Option<Submitted>, Refusal> {
        let (plan, owner) = (considered.plan, by.name.to_string());
        let circle = self.visibility.circle(by, &draft.spec);
        let instead_of = considered
            .latest
            .filter(|_| considered.lost)
            .map(|job| job.id);
        let (findings, permitted) = (considered.findings, considered.permitted);
        let anyone = by.is_anyone();
        let recorded = self.heavy(draft, move |it, draft| async move {
            let _turn = it.turn.lock().await;
            it.within(&owner, most).await?;
            it.memory
                .room_for_job(draft.kept)
                .map_err(Refusal::TooMany)?;
            let counts: Vec<Vec<Run>> = findings.iter().map(|f| f.counts.clone()).collect();
            let mut make_id = Uuid::now_v7;
            let prepared = prepare(
                &draft,
                owner,
                &circle,
                &counts,
                &mut make_id,
                it.clock.now_ms(),
            );
            let dropped = findings.iter().zip(draft.stages());
            let gone: Vec<Gone> = dropped
                .flat_map(|(f, stage)| f.dropped(&stage.set))
                .collect();
            let owner = Owner::from(&prepared.job);
            // Without tokens, all users are the same caller, who owns nothing.
            let places = match anyone {
                true => Vec::new(),
                false => places::written(&draft.spec.stages, &prepared.stages, &owner),
            };
            let places: Vec<OwnedPlace> = places.into_iter().map(|(_, place)| place).collect();
            it.commit(prepared, (&gone, &after), instead_of, (&places, &permitted))
                .await
        });
        let Some(job) = recorded.await? else {
            return Ok(None);
        };
        Ok(Some(Submitted {
            job,
            existed: false,
            plan,
        }))
    }

    async fn commit(
        &self,
        prepared: Prepared,
        (gone, after): (&[Gone], &[JobId]),
        instead_of: Option<JobId>,
        (places, permitted): (&[OwnedPlace], &[String]),
    ) -> Result<Option<JobId>, Refusal> {
        let Prepared {
            job,
            stages,
            ranges,
            events,
        } = prepared;
        let submission = Submission {
            gone,
            after,
            instead_of,
            places,
            permitted,
            ..Submission::new(&job, &stages, &ranges, &events)
        };
        match self.catalog.record(&submission).await {
            Ok(Outcome::New) => {}
            Ok(Outcome::Exists | Outcome::Changed) => return Ok(None),
            Err(error) => return Err(self.unwritable(error).await),
        }
        let id = job.id;
        self.announce(job, stages).await?;
        Ok(Some(id))
    }
}
