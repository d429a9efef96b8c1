//! Plans and submits jobs outside the actor. A spec is compared with the catalog and the stores,
//! and is recorded in one transaction. The actor only learns that there is a new job.
//!
//! An output counts for a new job if it was found in its store. Outputs that a worker reported and
//! nobody has checked since are planned as pending, and a worker looks for them. So are outputs
//! committed while the job is being planned.

mod check;
mod draft;
mod files;
mod foresee;
mod judge;
mod look;
mod places;
mod report;
mod verify;

use std::sync::Arc;

use picofarm_catalog::{
    Catalog, CatalogError, Gone, Job, Outcome, OwnedPlace, Owner, Recorded, ResultSet, Run, Specs,
    StageRecord, Submission,
};
use picofarm_proto::{
    ids::JobId,
    model::{JobPlan, JobState, SpecError},
};
use tokio::sync::{Mutex, mpsc};
use uuid::Uuid;

use crate::{
    actor::{Command, Refusal, Submitted},
    auth::{Caller, Visibility, not_yours},
    clock::Clock,
    core::{Learnt, Listed, Prepared, Timings, may_force, place_is_free, prepare, stands_for},
    lanes::Lanes,
    memory::{Charge, Memory, kept_cost},
    stored::{Found, Stored},
};
use check::Findings;
use look::Stores;

pub(crate) use draft::Draft;

/// Recent jobs with which a new one is compared.
const RECENT: u32 = 50;
/// Most attempts to plan a submission again because the catalog changed meanwhile.
const ATTEMPTS: usize = 4;

/// Plans and submits jobs.
#[derive(Clone)]
pub(crate) struct Submissions {
    catalog: Arc<dyn Catalog>,
    lanes: Lanes,
    stores: Stores,
    commands: mpsc::Sender<Command>,
    clock: Clock,
    /// Which jobs of others a caller can see.
    visibility: Visibility,
    memory: Arc<Memory>,
    /// Evidence of whether the stores here are those of the workers.
    evidence: verify::Evidence,
    /// Locked while a job is counted against its user's quota and recorded.
    turn: Arc<Mutex<()>>,
}

/// The catalog's data about a draft.
struct Facts {
    /// Recorded outputs, by stage.
    recorded: Vec<Vec<Recorded>>,
    /// By stage, of jobs with other lists of files; with the outputs that are recorded of them.
    listed: Vec<Vec<(Listed, Vec<Recorded>)>>,
    latest: Option<Latest>,
    /// Normal forms of others' places that the caller may write into.
    permitted: Vec<String>,
}

/// The latest job with the same spec.
#[derive(Debug, Clone)]
struct Latest {
    id: JobId,
    state: JobState,
    owner: Owner,
}

/// A draft with its plan.
struct Considered {
    plan: JobPlan,
    latest: Option<Latest>,
    /// Whether the latest job is done but some of its results are missing.
    lost: bool,
    /// Findings, by stage.
    findings: Vec<Findings>,
    /// Normal forms of others' places that the caller may write into.
    permitted: Vec<String>,
}

impl Submissions {
    pub(crate) fn new(
        catalog: Arc<dyn Catalog>,
        lanes: Lanes,
        stored: Option<Arc<dyn Stored>>,
        commands: mpsc::Sender<Command>,
        clock: Clock,
        visibility: Visibility,
        memory: Arc<Memory>,
    ) -> Self {
        Self {
            catalog,
            lanes,
            stores: Stores::new(stored),
            commands,
            clock,
            visibility,
            memory,
            evidence: Arc::default(),
            turn: Arc::default(),
        }
    }

    /// Returns what submitting the draft would do.
    pub(crate) async fn plan(&self, draft: &Arc<Draft>, by: &Caller) -> Result<JobPlan, Refusal> {
        self.in_time(draft)?;
        Ok(self.consider(draft, by).await?.plan)
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

    /// Adds warnings and estimates to a plan.
    async fn foresee(
        &self,
        draft: &Draft,
        plan: &mut JobPlan,
        recent: &[Job],
    ) -> Result<(), Refusal> {
        let (reply, answer) = tokio::sync::oneshot::channel();
        let ask = Command::Fits(Arc::clone(&draft.spec), reply);
        let gone = || Refusal::NotNow("the coordinator is stopping; try again".into());
        self.commands.send(ask).await.map_err(|_| gone())?;
        let fits = answer.await.map_err(|_| gone())??;
        let stages = draft.spec.stages.iter().zip(&fits.stages);
        for (planned, (stage, fit)) in plan.stages.iter_mut().zip(stages) {
            planned.workers = fit.able;
            if planned.run == 0 {
                continue;
            }
            let mut measured = Vec::new();
            for other in foresee::similar(stage, recent) {
                let timing = self.catalog.timing(&ResultSet::of(other)).await;
                measured.push((other, timing.map_err(broken)?));
            }
            (planned.task_seconds, planned.task_bytes, planned.measured) =
                foresee::estimate(stage, fit, &measured);
        }
        plan.warnings = foresee::warnings(&draft.spec, plan, &fits);
        Ok(())
    }

    /// Records a job, unless an existing one is reused. `most` limits the caller's unfinished jobs.
    pub(crate) async fn submit(
        &self,
        draft: &Arc<Draft>,
        by: &Caller,
        most: u64,
        again: bool,
    ) -> Result<Submitted, Refusal> {
        self.in_time(draft)?;
        for _ in 0..ATTEMPTS {
            let considered = self.consider(draft, by).await?;
            let latest = considered.latest.as_ref();
            let stands = latest.filter(|job| !considered.lost && stands_for(job.state, again));
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
                return Err(Refusal::Denied(not_yours(&job.id, &job.owner)));
            }
            if let Some(submitted) = self.record(draft, by, most, considered).await? {
                return Ok(submitted);
            }
        }
        Err(Refusal::NotNow(
            "what the job would reuse, or the same job of someone else, kept changing; try again"
                .into(),
        ))
    }

    async fn consider(&self, draft: &Arc<Draft>, by: &Caller) -> Result<Considered, Refusal> {
        let sight = by.sight(self.visibility);
        let whose = by.clone();
        let facts = self
            .heavy(
                draft,
                |it, draft| async move { it.facts(&draft, &whose).await },
            )
            .await?;
        let Facts {
            recorded,
            listed,
            latest,
            permitted,
        } = facts;
        let until = look::deadline();
        for (position, listed) in listed.iter().enumerate() {
            self.unchanged(draft, position, listed, until).await?;
        }
        let mut findings = Vec::with_capacity(recorded.len());
        for (position, recorded) in recorded.into_iter().enumerate() {
            let elsewhere = files::elsewhere(&listed[position], &recorded);
            let mut found = self.look(draft, position, recorded, until).await?;
            found.elsewhere = elsewhere;
            findings.push(found);
        }
        let lost = latest.as_ref().is_some_and(|job| {
            let stages = draft.stages().iter().zip(&findings);
            let mut lost = stages.map(|(stage, f)| f.lost(stage.tasks, job.owner.user == *by.name));
            job.state == JobState::Done && lost.any(|lost| lost)
        });
        let existing = latest.as_ref().map(|job| job.id);
        let stands = !lost
            && latest
                .as_ref()
                .is_some_and(|job| job.state == JobState::Done);
        let (plan, findings) = self
            .heavy(draft, move |it, draft| async move {
                let catalog = Arc::clone(&it.catalog);
                let _charge = it.charge(&draft, Specs::Recent(RECENT, &sight)).await?;
                let recent = catalog.recent(RECENT, &sight).await.map_err(broken)?;
                let mut plan = report::plan(&draft, &findings, (existing, stands), &recent);
                it.foresee(&draft, &mut plan, &recent).await?;
                Ok((plan, findings))
            })
            .await?;
        Ok(Considered {
            plan,
            latest,
            lost,
            findings,
            permitted,
        })
    }

    /// Charges the memory for these specs until the value is dropped.
    async fn charge(&self, draft: &Draft, specs: Specs<'_>) -> Result<Option<Charge>, Refusal> {
        let bytes = self.catalog.spec_bytes(specs).await.map_err(broken)?;
        draft.charge(bytes).await.map_err(Refusal::TooMany)
    }

    /// Collects the catalog's data about a draft.
    async fn facts(&self, draft: &Draft, by: &Caller) -> Result<Facts, Refusal> {
        let catalog = &self.catalog;
        let sight = by.sight(self.visibility);
        let permitted = self.permitted(draft, by).await?;
        let mut recorded = Vec::with_capacity(draft.stages().len());
        let mut others_listed = Vec::with_capacity(draft.stages().len());
        for (stage, record) in draft.spec.stages.iter().zip(draft.stages()) {
            let set = &record.set;
            let writes = stage.task.writes().is_some();
            let mut listed = Vec::new();
            if writes || stage.force {
                let at = Specs::At(&set.store, &set.dataset);
                let _charge = self.charge(draft, at).await?;
                let others = catalog.jobs_at(&set.store, &set.dataset).await;
                let others = others.map_err(broken)?;
                if writes {
                    let there = place_is_free(stage, set, &others, &sight)
                        .map_err(|why| Refusal::Spec(draft.spec.at(stage, why)))?;
                    for other in there {
                        let recorded = catalog.recorded(&other.set, record.tasks).await;
                        listed.push((other, recorded.map_err(broken)?));
                    }
                }
                if stage.force {
                    may_force(stage, set, &others, by, &sight).map_err(Refusal::Denied)?;
                }
            }
            recorded.push(catalog.recorded(set, record.tasks).await.map_err(broken)?);
            others_listed.push(listed);
        }
        let circle = self.visibility.circle(by, &draft.spec);
        let identity = draft.identity(&circle);
        let _charge = self.charge(draft, Specs::With(&identity)).await?;
        let latest = catalog.job_with(&identity).await;
        let latest = latest.map_err(broken)?;
        Ok(Facts {
            recorded,
            listed: others_listed,
            latest: latest.map(|job| Latest {
                owner: Owner::from(&job),
                id: job.id,
                state: job.state,
            }),
            permitted,
        })
    }

    /// Checks that the caller may write into every place that the job names. Returns the places
    /// owned by others.
    async fn permitted(&self, draft: &Draft, by: &Caller) -> Result<Vec<String>, Refusal> {
        let sight = by.sight(self.visibility);
        let owner = Owner {
            user: by.name.to_string(),
            project: draft.spec.project.clone(),
        };
        let mut permitted = Vec::new();
        for (position, mine) in places::written(&draft.spec.stages, draft.stages(), &owner) {
            let (stage, record) = (&draft.spec.stages[position], &draft.stages()[position]);
            let near = self.catalog.owned_near(&mine.place).await.map_err(broken)?;
            for (other, may_write) in places::of_others(&mine, &near, by) {
                if !may_write {
                    // The same results may be reused, but none may be added.
                    let theirs = self.catalog.largest_stage(&record.set, &other.owner.user);
                    let theirs = theirs.await.map_err(broken)?;
                    if other.place != mine.place || record.tasks > theirs {
                        let why = places::refused(stage, &mine, other, &sight);
                        return Err(Refusal::Denied(draft.spec.at(stage, why).to_string()));
                    }
                }
                permitted.push(other.place.clone());
            }
        }
        Ok(permitted)
    }

    /// Checks a stage's recorded outputs against its store.
    async fn look(
        &self,
        draft: &Draft,
        position: usize,
        recorded: Vec<Recorded>,
        until: tokio::time::Instant,
    ) -> Result<Findings, Refusal> {
        let (stage, set) = (&draft.spec.stages[position], &draft.stages()[position].set);
        let chosen = check::choose(&recorded, &draft.hash);
        let some: Vec<Recorded> = chosen.iter().map(|i| recorded[*i]).collect();
        let (mut found, mut why) = self.stores.look(stage, &set.store, &some, until).await;
        if why.is_none() && check::suspicious(&recorded, &found) {
            let passed = recorded.iter().filter(|o| !found.contains_key(&o.task));
            let passed: Vec<Recorded> = passed.copied().collect();
            let (more, stopped) = self.stores.look(stage, &set.store, &passed, until).await;
            found.extend(more);
            why = stopped;
        }
        if let Some(another) = self.sees_another_disk(set.store.trim_end_matches('/')) {
            found.retain(|_, found| *found == Found::Equal);
            why = Some(another);
        }
        let is_new = |o: &&Recorded| !o.checked && found.get(&o.task) == Some(&Found::Equal);
        let new: Vec<Recorded> = recorded.iter().filter(is_new).copied().collect();
        if !new.is_empty()
            && let Err(error) = self.catalog.mark_checked(set, &new).await
        {
            return Err(self.unwritable(error).await);
        }
        Ok(check::judge(&recorded, &found, why))
    }

    /// Records the job. Returns `None` if the catalog has changed since the job was considered.
    async fn record(
        &self,
        draft: &Arc<Draft>,
        by: &Caller,
        most: u64,
        considered: Considered,
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
            if it.catalog.jobs_of(&owner).await.map_err(broken)? >= most {
                return Err(Refusal::TooMany(format!(
                    "{owner:?} has {most} jobs that have not ended, the most that --max-jobs-per-user allows; wait for \
                     some to end, or cancel some"
                )));
            }
            it.memory.room_for_job(draft.kept).map_err(Refusal::TooMany)?;
            let counts: Vec<Vec<Run>> = findings.iter().map(|f| f.counts.clone()).collect();
            let mut make_id = Uuid::now_v7;
            let prepared = prepare(&draft, owner, &circle, &counts, &mut make_id, it.clock.now_ms());
            let dropped = findings.iter().zip(draft.stages());
            let gone: Vec<Gone> = dropped.flat_map(|(f, stage)| f.dropped(&stage.set)).collect();
            let owner = Owner::from(&prepared.job);
            // Without tokens, all users are the same caller, who owns nothing.
            let places = match anyone {
                true => Vec::new(),
                false => places::written(&draft.spec.stages, &prepared.stages, &owner),
            };
            let places: Vec<OwnedPlace> = places.into_iter().map(|(_, place)| place).collect();
            it.commit(prepared, &gone, instead_of, (&places, &permitted)).await
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
        gone: &[Gone],
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

    /// Returns the refusal after a failed catalog write. The actor is notified unless the content
    /// is at fault.
    async fn unwritable(&self, error: CatalogError) -> Refusal {
        if matches!(error, CatalogError::Refused { .. }) {
            return broken(error);
        }
        let why = Refusal::Catalog(error.to_string());
        // If the actor is gone, it already knows.
        let _ = self.commands.send(Command::Broken(error)).await;
        why
    }

    /// Sends a recorded job to the actor and waits until the actor has added it.
    async fn announce(&self, job: Job, stages: Vec<StageRecord>) -> Result<(), Refusal> {
        let mut timings = Timings::new();
        for stage in &stages {
            let timing = self.catalog.timing(&stage.set).await.map_err(broken)?;
            timings.insert(stage.set.clone(), timing);
        }
        // A job without any task to run has already ended.
        let state = self.catalog.state(job.id).await.map_err(broken)?;
        let learnt = Learnt {
            kept: kept_cost(&job.spec),
            job,
            stages,
            timings,
        };
        let learnt = (state == Some(JobState::Active)).then_some(learnt);
        let (reply, answer) = tokio::sync::oneshot::channel();
        let command = Command::Learn(learnt.map(Box::new), reply);
        if self.commands.send(command).await.is_ok() {
            // If the actor is between two lives, it finds the job in the catalog.
            let _ = answer.await;
        }
        Ok(())
    }

    /// Sends the actor a job that it does not know yet, if the job is active.
    pub(crate) async fn learn(&self, id: JobId) -> Result<(), Refusal> {
        let it = self.clone();
        self.lanes
            .read(move || async move {
                match it.catalog.job(id).await.map_err(broken)? {
                    Some(record) => {
                        let stages = record.job.stages();
                        it.announce(record.job, stages).await
                    }
                    None => Ok(()),
                }
            })
            .await
    }

    /// Runs slow work on a draft on a separate thread.
    async fn heavy<T, F>(
        &self,
        draft: &Arc<Draft>,
        work: impl FnOnce(Self, Arc<Draft>) -> F + Send + 'static,
    ) -> T
    where
        T: Send + 'static,
        F: Future<Output = T>,
    {
        let (it, draft) = (self.clone(), Arc::clone(draft));
        self.lanes.heavy(draft.bytes, move || work(it, draft)).await
    }
}

fn broken(error: CatalogError) -> Refusal {
    match error {
        CatalogError::Refused { what, .. } => Refusal::Content(what),
        error => Refusal::Catalog(error.to_string()),
    }
}
