//! Compares a submission with the jobs that have results in the same data set. Pure.
//!
//! An earlier job may have the same settings and another list of files, because a file was
//! corrected or files were added. Results of equal content are taken over. Results of other content
//! refuse the job.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_catalog::{Job, Owner, Recorded, ResultSet, Sight};
use picofarm_proto::{
    ids::JobId,
    spec::{SceneFile, SpecError, StageSpec},
};

use crate::{
    auth::{Caller, not_owner},
    core::plan,
};

/// Another job's scenes of a list of files in the data set that a stage writes to. But for files
/// whose content differs, they are the stage's own: workers take them over.
#[derive(Debug, Clone)]
pub(crate) struct FileOverlap {
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
pub(crate) fn check_dataset_free(
    stage: &StageSpec,
    set: &ResultSet,
    others: &[Job],
    sight: &Sight,
) -> Result<Vec<FileOverlap>, SpecError> {
    let mut listed = Vec::new();
    let files = stage.task.files_key();
    for other in others {
        for there in &other.spec.stages {
            let theirs = ResultSet::of_stage(there);
            if (&theirs.store, &theirs.dataset) != (&set.store, &set.dataset)
                || theirs.stage_key == set.stage_key
            {
                continue;
            }
            let seen = sight.sees(&Owner::from(other));
            if files.is_some() && there.task.files_key() == files {
                let (equal, changed) = compare_files(stage, there);
                listed.push(FileOverlap {
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
pub(crate) fn changed_file_error(
    stage: &StageSpec,
    set: &ResultSet,
    scene: u64,
    listed: &FileOverlap,
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
    let has = |job: &&Job| {
        job.spec
            .stages
            .iter()
            .any(|s| ResultSet::of_stage(s) == *set)
    };
    let Some(first) = others.iter().rev().find(has) else {
        return Ok(());
    };
    let owner = Owner::from(first);
    if by.may_change(&owner) {
        return Ok(());
    }
    let whose = match sight.sees(&owner) {
        true => not_owner(&first.id, &owner),
        false => "you may not see its job".to_owned(),
    };
    Err(format!(
        "stage {:?} cannot be forced, since its results are another's: {whose}; submit without --force to reuse what exists",
        stage.name
    ))
}

/// Scenes that other jobs have made of files that a stage lists, too.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct ReusedScenes {
    /// How many.
    pub scenes: u64,
    /// The latest of these jobs that the caller may see.
    pub job: Option<JobId>,
}

/// Returns the records of equal files, except those of the stage itself.
pub(super) fn elsewhere(listed: &[(FileOverlap, Vec<Recorded>)], own: &[Recorded]) -> ReusedScenes {
    let own: BTreeSet<u64> = own.iter().map(|output| output.task).collect();
    let mut scenes = BTreeSet::new();
    let mut job = None;
    for (other, recorded) in listed {
        let equal = recorded.iter().map(|output| output.task);
        let equal: Vec<u64> = equal
            .filter(|task| other.equal.contains(task) && !own.contains(task))
            .collect();
        if !equal.is_empty() {
            job = job.max(other.job.as_ref().map(|(id, _)| *id));
        }
        scenes.extend(equal);
    }
    ReusedScenes {
        scenes: scenes.len() as u64,
        job,
    }
}
