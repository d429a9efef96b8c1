//! Submits jobs, ends them, and reports this instance's knowledge of them.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use picofarm_catalog::{
    Job, JobRecord, NewEvent, Owner, Range, ResultSet, Run, Sight, StageRecord, Timing,
};
use picofarm_proto::{
    ids::{JobId, RangeId, StageRef, WorkerId},
    model::{
        EventKind, JobSpec, JobState, JobStatus, RunningTask, SceneFile, SpecError, StageSpec,
        StageState, StageStatus,
    },
};
use uuid::Uuid;

use super::{Core, Say};
use crate::{
    auth::{Caller, not_yours},
    plan,
    submission::Draft,
    transition::RangeEvent,
};

/// A job ready to be recorded.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Prepared {
    pub job: Job,
    pub stages: Vec<StageRecord>,
    /// Pending ranges that no instance has claimed.
    pub ranges: Vec<Range>,
    pub events: Vec<NewEvent>,
}

/// Another job's scenes of a list of files in the data set that a stage writes to. But for files
/// whose content differs, they are the stage's own: workers take them over.
#[derive(Debug, Clone)]
pub(crate) struct Listed {
    /// The other job, where the caller may see it.
    pub job: Option<(JobId, String)>,
    /// Where its outputs are recorded.
    pub set: ResultSet,
    /// Scenes that both make of the same content.
    pub equal: BTreeSet<u64>,
    /// Scenes whose file has another content now, with the file as it was.
    pub changed: BTreeMap<u64, SceneFile>,
}

/// Checks that no job has put scenes of other settings into the data set that a stage names: their
/// keys would be the same, their bytes not. `set` is where the stage writes, `others` are the jobs
/// that write there; those that `sight` does not see are not named. Returns what jobs with the same
/// settings and another list of files have to do there.
///
/// # Errors
/// Returns a [`SpecError`] at `output.dataset` that names the job and the first setting that
/// differs.
pub(crate) fn place_is_free(
    stage: &StageSpec,
    set: &ResultSet,
    others: &[Job],
    sight: &Sight,
) -> Result<Vec<Listed>, SpecError> {
    let mut listed = Vec::new();
    let files = stage.task.files_key();
    for other in others {
        for there in &other.spec.stages {
            let theirs = ResultSet::of(there);
            if (&theirs.store, &theirs.dataset) != (&set.store, &set.dataset)
                || theirs.stage_key == set.stage_key
            {
                continue;
            }
            let seen = sight.sees(&Owner::from(other));
            if files.is_some() && there.task.files_key() == files {
                let (equal, changed) = compare_files(stage, there);
                listed.push(Listed {
                    job: seen.then(|| (other.id, other.spec.name.clone())),
                    set: theirs,
                    equal,
                    changed,
                });
                continue;
            }
            if !seen {
                return Err(SpecError::new(
                    "output.dataset",
                    format!(
                        "{:?} in {} holds scenes of a job that you may not see, with other settings; name another data set",
                        set.dataset, set.store
                    ),
                ));
            }
            let changes = plan::changes(there, stage).join(", ");
            return Err(SpecError::new(
                "output.dataset",
                format!(
                    "{:?} in {} holds scenes of job {} ({:?}) with other settings: {changes}; \
                     name another data set, or use that job's settings",
                    set.dataset, set.store, other.id, other.spec.name
                ),
            ));
        }
    }
    Ok(listed)
}

/// The scenes that two stages make of files of the same content, and those of which the first has
/// another content than the second, with the second's files.
fn compare_files(
    stage: &StageSpec,
    there: &StageSpec,
) -> (BTreeSet<u64>, BTreeMap<u64, SceneFile>) {
    let file = |stage: &StageSpec, scene| stage.task.scenes()?.kind.file(scene).cloned();
    let (mut equal, mut changed) = (BTreeSet::new(), BTreeMap::new());
    for scene in 0..stage.tasks().min(there.tasks()) {
        match (file(stage, scene), file(there, scene)) {
            (Some(is), Some(was)) if is.sha256 == was.sha256 => {
                equal.insert(scene);
            }
            (Some(_), Some(was)) => {
                changed.insert(scene, was);
            }
            _ => {}
        }
    }
    (equal, changed)
}

/// Says that a scene of the data set was made of another content than its file has now.
pub(crate) fn made_of_another(
    stage: &StageSpec,
    set: &ResultSet,
    scene: u64,
    listed: &Listed,
) -> SpecError {
    let field = format!("scenes.files[{scene}]");
    let (Some(was), Some(is)) = (
        listed.changed.get(&scene),
        stage.task.scenes().and_then(|s| s.kind.file(scene)),
    ) else {
        unreachable!("both list a file for a scene that is compared");
    };
    let job = match &listed.job {
        Some((id, name)) => format!("job {id} ({name:?})"),
        None => "a job that you may not see".to_owned(),
    };
    let before = match (is.path == was.path, &listed.job) {
        (true, _) => "an earlier content of this file".to_owned(),
        (false, Some(_)) => was.path.clone(),
        (false, None) => "another file".to_owned(),
    };
    let what = format!(
        "{} has SHA-256 {}, but {job} made scene {scene} of {:?} in {} of {before} (SHA-256 {}), and a finished scene is not \
         replaced; name another data set, or list the file as it was in this position",
        is.path, is.sha256, set.dataset, set.store, was.sha256
    );
    SpecError::new(field, what)
}

/// Checks that a caller may run a stage with existing results again. The results belong to the
/// first job that has them. `others` are the jobs that write to `set`, the stage's result set,
/// latest first.
///
/// # Errors
/// Returns an error that names the owner of the results.
pub(crate) fn may_force(
    stage: &StageSpec,
    set: &ResultSet,
    others: &[Job],
    by: &Caller,
    sight: &Sight,
) -> Result<(), String> {
    let has = |job: &&Job| job.spec.stages.iter().any(|s| ResultSet::of(s) == *set);
    let Some(first) = others.iter().rev().find(has) else {
        return Ok(());
    };
    let owner = Owner::from(first);
    if by.may_change(&owner) {
        return Ok(());
    }
    let whose = match sight.sees(&owner) {
        true => not_yours(&first.id, &owner),
        false => "you may not see its job".to_owned(),
    };
    Err(format!(
        "stage {:?} cannot be forced, since its results are another's: {whose}; submit without --force to reuse what exists",
        stage.name
    ))
}

/// Returns whether the latest job with a spec, in this state, is reused for a new submission. It is
/// not if the job ended badly and the caller asks to run it again.
pub(crate) fn stands_for(state: JobState, again: bool) -> bool {
    !(again && matches!(state, JobState::Failed | JobState::Cancelled))
}

/// Divides a job into ranges, given the existing outputs by stage. An equal job is looked up in
/// `circle`.
pub(crate) fn prepare(
    draft: &Draft,
    user: String,
    circle: &str,
    existing: &[Vec<Run>],
    make_id: &mut dyn FnMut() -> Uuid,
    now_ms: i64,
) -> Prepared {
    let id = JobId::from_uuid(make_id());
    let (job, stages) = draft.job(id, user, circle, now_ms);
    let mut ranges = Vec::new();
    let mut reused = Vec::new();
    let (mut total, mut there) = (0, 0);
    for (stage, existing) in stages.iter().zip(existing) {
        let existing: &[Run] = if stage.force { &[] } else { existing };
        let mut ids = || RangeId::from_uuid(make_id());
        ranges.extend(plan::expand(stage.id, stage.tasks, existing, &mut ids));
        total += stage.tasks;
        there += existing.iter().map(|r| r.hi - r.lo).sum::<u64>();
        reused.extend(existing.iter().map(|run| (stage.id.stage, *run)));
    }
    let message = format!("{total} tasks, {} to run", total - there);
    let mut events = vec![NewEvent::of(id, now_ms, EventKind::Submitted, message)];
    for (stage, run) in reused {
        let message = format!("outputs of tasks {}..{} exist already", run.lo, run.hi);
        let event = NewEvent::of(id, now_ms, EventKind::Reused, message);
        events.push(NewEvent {
            stage: Some(stage),
            tasks: Some(run),
            ..event
        });
    }
    Prepared {
        job,
        stages,
        ranges,
        events,
    }
}

/// A job to be added to the core.
#[derive(Debug, Clone)]
pub(crate) struct Learnt {
    pub job: Job,
    pub stages: Vec<StageRecord>,
    /// Timings of the job's result sets.
    pub timings: Timings,
    /// Memory used by the job's spec.
    pub kept: u64,
}

/// This instance's additions to the catalog's knowledge of jobs.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Overlay {
    /// Running tasks, by job.
    running: BTreeMap<JobId, Vec<RunningTask>>,
    /// Mean seconds of a task, by stage.
    means: BTreeMap<StageRef, Option<f64>>,
    /// Workers connected to any instance.
    workers: u32,
}

impl Overlay {
    /// Adds this instance's knowledge to a job's status.
    pub(crate) fn complete(&mut self, status: &mut JobStatus) {
        status.workers = self.workers;
        status.running = self.running.remove(&status.id).unwrap_or_default();
        for (ordinal, stage) in (0..).zip(&status.stages) {
            let id = StageRef {
                job: status.id,
                stage: ordinal,
            };
            // The estimate uses the last running stage, because the earlier ones are nearly done.
            if stage.state == StageState::Open
                && let Some(mean) = self.means.get(&id)
            {
                status.mean_task_seconds = *mean;
            }
        }
    }
}

/// Converts the catalog's record of a job to a status.
pub(crate) fn recorded_status(record: JobRecord) -> JobStatus {
    let counts = record.counts();
    let JobRecord {
        job,
        stages,
        timing,
        unverified,
    } = record;
    let stages = job.spec.stages.iter().zip(stages);
    JobStatus {
        id: job.id,
        name: job.spec.name.clone(),
        state: job.state,
        tasks: counts,
        submitted_at_ms: job.submitted_ms,
        ended_at_ms: job.ended_ms,
        paused: job.paused && job.state == JobState::Active,
        user: job.user,
        stages: stages
            .map(|(spec, stage)| StageStatus {
                name: spec.name.clone(),
                kind: spec.task.kind().to_owned(),
                state: stage.state,
                needs: spec.needs.clone(),
                tasks: stage.counts,
            })
            .collect(),
        spec: JobSpec {
            name: job.spec.name.clone(),
            priority: job.spec.priority,
            limits: job.spec.limits.clone(),
            nonce: job.spec.nonce.clone(),
            project: job.spec.project.clone(),
            // Lists of files may be long, so they are left out.
            stages: job.spec.stages.iter().map(|s| s.only(0, 0)).collect(),
        },
        mean_task_seconds: timing.mean(),
        running: Vec::new(),
        workers: 0,
        unverified,
    }
}

impl Core {
    /// Pauses or resumes a job. A paused job's tasks that no worker has begun go back; running
    /// tasks continue.
    pub(crate) fn paused(&mut self, job: JobId, paused: bool) {
        if paused {
            self.free_what_waits(job);
        }
        for (_, entry) in self.stages.iter_mut().filter(|(id, _)| id.job == job) {
            entry.job.paused = paused;
            entry.free = None;
            if paused {
                entry.stage.give_pending(&mut self.changes);
            }
        }
    }

    /// Takes back the tasks of a job's leases that their workers have not begun, as far as is
    /// known. A worker runs one task at a time and works through a lease in order.
    fn free_what_waits(&mut self, job: JobId) {
        let stages = self.stages.iter().filter(|(id, _)| id.job == job);
        let leases = stages.flat_map(|(_, entry)| entry.stage.leased());
        let leases: Vec<(Range, WorkerId)> = leases
            .map(|(range, lease)| (range.clone(), lease.worker))
            .collect();
        for (range, worker) in leases {
            let Some(entry) = self.workers.get(&worker) else {
                continue;
            };
            let session = entry.session;
            let busy = |id: &RangeId| self.progress.get(id).is_some_and(|tasks| !tasks.is_empty());
            let elsewhere = entry.leases.iter().any(|id| *id != range.id && busy(id));
            if elsewhere && !busy(&range.id) {
                let revoke = Say::Revoke {
                    lease: range.lease(),
                    reason: "the job is held".into(),
                };
                self.say.push((session, revoke));
                self.close(&range, false);
                continue;
            }
            let Some(last) = self.in_hand(&range).into_iter().max() else {
                continue;
            };
            let at = last + 1;
            if at < range.hi && (at..range.hi).all(|task| range.has_to_do(task)) {
                let lease = range.lease();
                self.say.push((session, Say::Trim { lease, hi: at }));
                self.mark(&range, &RangeEvent::Trim { at });
            }
        }
    }

    /// Returns the jobs that have passed their deadline.
    pub(crate) fn overdue(&self, now_ms: i64) -> BTreeMap<JobId, String> {
        let late = self.stages.iter().filter(|(_, entry)| {
            let deadline = entry.deadline_ms;
            deadline.is_some_and(|at| at <= now_ms)
        });
        late.map(|(id, entry)| (id.job, entry.job.spec.limits.deadline.clone()))
            .collect()
    }

    /// Removes a job after it has ended. Its leases are revoked, and its unfinished tasks go
    /// back to the catalog.
    pub(crate) fn drop_job(&mut self, job: JobId, reason: &str) {
        let stages: Vec<StageRef> = self
            .stages
            .keys()
            .copied()
            .filter(|stage| stage.job == job)
            .collect();
        for id in stages {
            let leases: Vec<_> = self.stages[&id]
                .stage
                .leased()
                .map(|(range, lease)| (range.clone(), lease.worker))
                .collect();
            for (range, worker) in leases {
                if let Some(entry) = self.workers.get(&worker) {
                    let revoke = Say::Revoke {
                        lease: range.lease(),
                        reason: reason.to_owned(),
                    };
                    self.say.push((entry.session, revoke));
                }
                self.close(&range, false);
            }
            if let Some(mut entry) = self.stages.remove(&id) {
                self.sets[entry.set].stages.remove(&id);
                entry.stage.give_pending(&mut self.changes);
            }
        }
    }

    /// Makes the given-up tasks of an active job pending again.
    pub(crate) fn retried(&mut self, job: JobId) {
        for (_, entry) in self.stages.iter_mut().filter(|(id, _)| id.job == job) {
            entry.exceptions.clear();
            entry.longest_ms = 0;
            entry.free = None;
        }
    }

    /// Returns this instance's knowledge of one job, or of all jobs.
    pub(crate) fn overlay(&self, one: Option<JobId>, now_ms: i64) -> Overlay {
        let mut overlay = Overlay {
            workers: self.everywhere(),
            ..Overlay::default()
        };
        let stages = self.stages.iter();
        for (id, entry) in stages.filter(|(id, _)| one.is_none_or(|job| id.job == job)) {
            let mean = self.sets[entry.set].timing.mean();
            overlay.means.insert(*id, mean);
            for (range, lease) in entry.stage.leased() {
                let Some(tasks) = self.progress.get(&range.id) else {
                    continue;
                };
                let running = overlay.running.entry(id.job).or_default();
                running.extend(tasks.iter().map(|(index, progress)| RunningTask {
                    stage: id.stage,
                    index: *index,
                    worker: self.name_of(lease.worker),
                    fraction: progress.fraction,
                    text: progress.at.text.clone(),
                    figures: progress.at.figures.clone(),
                    seconds: (now_ms - progress.since_ms).max(0) as f64 / 1000.0,
                }));
            }
        }
        for running in overlay.running.values_mut() {
            running.sort_by_key(|r| (r.stage, r.index));
        }
        overlay
    }

    /// Returns the number of workers connected to this instance.
    pub(crate) fn connected(&self) -> u32 {
        u32::try_from(self.workers.len()).unwrap_or(u32::MAX)
    }

    /// Returns the number of workers connected to any instance.
    pub(crate) fn everywhere(&self) -> u32 {
        self.connected() + self.elsewhere
    }
}

/// The known timings of result sets.
pub(crate) type Timings = HashMap<ResultSet, Timing>;
