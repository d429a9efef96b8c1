//! Compares a draft with the catalog and the stores, and plans it.

use std::sync::Arc;

use picofarm_catalog::{Job, Owner, Recorded, ResultSet, Specs};
use picofarm_proto::{
    ids::JobId,
    messages::{JobPlan, JobState},
};

use super::{
    check::{self, Findings},
    conflicts::{FileOverlap, changed_file_error, check_dataset_free, elsewhere, may_force},
    draft::Draft,
    foresee, places, report,
    result_reader::ResultState,
    service::{Submissions, broken},
    store_checks::plan_deadline,
};
use crate::{
    actor::{Command, Refusal},
    auth::Caller,
};

/// Recent jobs with which a new one is compared.
const RECENT: u32 = 50;

/// The catalog's data about a draft.
struct CatalogFacts {
    /// Recorded outputs, by stage.
    recorded: Vec<Vec<Recorded>>,
    /// By stage, of jobs with other lists of files; with the outputs that are recorded of them.
    listed: Vec<Vec<(FileOverlap, Vec<Recorded>)>>,
    latest: Option<EqualJob>,
    /// Normal forms of others' places that the caller may write into.
    permitted: Vec<String>,
}

/// The latest job with the same spec.
#[derive(Debug, Clone)]
pub(super) struct EqualJob {
    pub(super) id: JobId,
    pub(super) state: JobState,
    pub(super) owner: Owner,
}

/// A draft with its plan.
pub(super) struct Considered {
    pub(super) plan: JobPlan,
    pub(super) latest: Option<EqualJob>,
    /// Whether the latest job is done but some of its results are missing.
    pub(super) lost: bool,
    /// Findings, by stage.
    pub(super) findings: Vec<Findings>,
    /// Normal forms of others' places that the caller may write into.
    pub(super) permitted: Vec<String>,
}

impl Submissions {
    pub(super) async fn consider(
        &self,
        draft: &Arc<Draft>,
        by: &Caller,
    ) -> Result<Considered, Refusal> {
        let sight = by.sight(self.visibility);
        let whose = by.clone();
        let facts = self
            .heavy(
                draft,
                |it, draft| async move { it.facts(&draft, &whose).await },
            )
            .await?;
        let CatalogFacts {
            recorded,
            listed,
            latest,
            permitted,
        } = facts;
        let until = plan_deadline();
        for (position, listed) in listed.iter().enumerate() {
            self.unchanged(draft, position, listed, until).await?;
        }
        let mut findings = Vec::with_capacity(recorded.len());
        for (position, recorded) in recorded.into_iter().enumerate() {
            let elsewhere = elsewhere(&listed[position], &recorded);
            let mut found = self.check_stage(draft, position, recorded, until).await?;
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

    /// Collects the catalog's data about a draft.
    async fn facts(&self, draft: &Draft, by: &Caller) -> Result<CatalogFacts, Refusal> {
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
                    let there = check_dataset_free(stage, set, &others, &sight)
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
        Ok(CatalogFacts {
            recorded,
            listed: others_listed,
            latest: latest.map(|job| EqualJob {
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
            for (other, may_write) in places::owned_by_others(&mine, &near, by) {
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
    async fn check_stage(
        &self,
        draft: &Draft,
        position: usize,
        recorded: Vec<Recorded>,
        until: tokio::time::Instant,
    ) -> Result<Findings, Refusal> {
        let (stage, set) = (&draft.spec.stages[position], &draft.stages()[position].set);
        let chosen = check::choose(&recorded, &draft.hash);
        let some: Vec<Recorded> = chosen.iter().map(|i| recorded[*i]).collect();
        let (mut found, mut why) = self.stores.check(stage, &set.store, &some, until).await;
        if why.is_none() && check::suspicious(&recorded, &found) {
            let passed = recorded.iter().filter(|o| !found.contains_key(&o.task));
            let passed: Vec<Recorded> = passed.copied().collect();
            let (more, stopped) = self.stores.check(stage, &set.store, &passed, until).await;
            found.extend(more);
            why = stopped;
        }
        if let Some(another) = self
            .evidence
            .sees_another_disk(set.store.trim_end_matches('/'))
        {
            found.retain(|_, found| *found == ResultState::Equal);
            why = Some(another);
        }
        let is_new = |o: &&Recorded| !o.checked && found.get(&o.task) == Some(&ResultState::Equal);
        let new: Vec<Recorded> = recorded.iter().filter(is_new).copied().collect();
        if !new.is_empty()
            && let Err(error) = self.catalog.mark_checked(set, &new).await
        {
            return Err(self.unwritable(error).await);
        }
        Ok(check::judge(&recorded, &found, why))
    }

    /// Refuses a stage one of whose files has another content than the scene was made of that the
    /// data set holds in its place. Scenes that were deleted do not count.
    async fn unchanged(
        &self,
        draft: &Draft,
        position: usize,
        listed: &[(FileOverlap, Vec<Recorded>)],
        until: tokio::time::Instant,
    ) -> Result<(), Refusal> {
        let (stage, set) = (&draft.spec.stages[position], &draft.stages()[position].set);
        for (other, recorded) in listed {
            let made = recorded.iter();
            let made = made.filter(|output| other.changed.contains_key(&output.task));
            let made: Vec<Recorded> = made.copied().collect();
            let (found, _) = self.stores.check(stage, &set.store, &made, until).await;
            // What cannot be looked at is there.
            let there = made.iter().find(|output| {
                matches!(
                    found.get(&output.task),
                    None | Some(ResultState::Equal | ResultState::NoFolder)
                )
            });
            if let Some(output) = there {
                let why = changed_file_error(stage, set, output.task, other);
                return Err(Refusal::Spec(draft.spec.at(stage, why)));
            }
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
        let ask = Command::EligibleWorkers(Arc::clone(&draft.spec), reply);
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
                let timing = self.catalog.timing(&ResultSet::of_stage(other)).await;
                measured.push((other, timing.map_err(broken)?));
            }
            (planned.task_seconds, planned.task_bytes, planned.measured) =
                foresee::estimate(stage, fit, &measured);
        }
        plan.warnings = foresee::warnings(&draft.spec, plan, &fits);
        Ok(())
    }
}
