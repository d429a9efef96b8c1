//! Compares scenes of files with an earlier job that has the same settings and another list of
//! files, because a file was corrected or files were added. Results of equal content are taken
//! over. Results of other content refuse the job.

use std::collections::BTreeSet;

use picofarm_catalog::Recorded;
use picofarm_proto::ids::JobId;
use tokio::time::Instant;

use super::{Draft, Submissions};
use crate::{
    actor::Refusal,
    core::{Listed, made_of_another},
    stored::Found,
};

/// Scenes that other jobs have made of files that a stage lists, too.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Elsewhere {
    /// How many.
    pub scenes: u64,
    /// The latest of these jobs that the caller may see.
    pub job: Option<JobId>,
}

/// Returns the records of equal files, except those of the stage itself.
pub(super) fn elsewhere(listed: &[(Listed, Vec<Recorded>)], own: &[Recorded]) -> Elsewhere {
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
    Elsewhere {
        scenes: scenes.len() as u64,
        job,
    }
}

impl Submissions {
    /// Refuses a stage one of whose files has another content than the scene was made of that the
    /// data set holds in its place. Scenes that were deleted do not count.
    pub(super) async fn unchanged(
        &self,
        draft: &Draft,
        position: usize,
        listed: &[(Listed, Vec<Recorded>)],
        until: Instant,
    ) -> Result<(), Refusal> {
        let (stage, set) = (&draft.spec.stages[position], &draft.stages()[position].set);
        for (other, recorded) in listed {
            let made = recorded.iter();
            let made = made.filter(|output| other.changed.contains_key(&output.task));
            let made: Vec<Recorded> = made.copied().collect();
            let (found, _) = self.stores.look(stage, &set.store, &made, until).await;
            // What cannot be looked at is there.
            let there = made.iter().find(|output| {
                matches!(
                    found.get(&output.task),
                    None | Some(Found::Equal | Found::NoFolder)
                )
            });
            if let Some(output) = there {
                let why = made_of_another(stage, set, output.task, other);
                return Err(Refusal::Spec(draft.spec.at(stage, why)));
            }
        }
        Ok(())
    }
}
