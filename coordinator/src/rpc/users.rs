//! Each caller's jobs that have not ended, as far as this process has seen them submitted: what `jobs_per_user` counts.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{Arc, Mutex},
};

use picofarm_proto::{
    ids::JobId,
    model::{JobSpec, JobState},
};
use tonic::Status;

use super::Link;
use crate::{actor::Command, auth::Caller};

/// The jobs of each caller.
#[derive(Clone, Default)]
pub(crate) struct UserJobs(Arc<Mutex<HashMap<Arc<str>, Jobs>>>);

#[derive(Default)]
struct Jobs {
    active: BTreeSet<JobId>,
    /// Submissions that have not been answered.
    under_way: usize,
}

impl UserJobs {
    /// Room for one more job of `caller`, if the limit has it or the job is there already.
    ///
    /// # Errors
    /// RESOURCE_EXHAUSTED, with the limit's name; or what asking for the caller's other jobs answered.
    pub(crate) async fn reserve(
        &self,
        link: &Link,
        caller: &Caller,
        limit: usize,
        spec: &JobSpec,
    ) -> Result<Room, Status> {
        if let Some(room) = self.room(&caller.name, limit) {
            return Ok(room);
        }
        for id in self.active(&caller.name) {
            let ended = match link.ask(|reply| Command::Get(id, reply)).await {
                Ok(status) => status.state != JobState::Active,
                Err(status) if status.code() == tonic::Code::NotFound => true,
                Err(status) => return Err(status),
            };
            if ended {
                self.with(&caller.name, |jobs| jobs.active.remove(&id));
            }
        }
        if let Some(room) = self.room(&caller.name, limit) {
            return Ok(room);
        }
        // A job that is there already takes no room.
        let plan = link
            .ask(|reply| Command::Plan(Box::new(spec.clone()), reply))
            .await?;
        if plan.existing_job.is_some()
            && let Some(room) = self.room(&caller.name, usize::MAX)
        {
            return Ok(room);
        }
        Err(Status::resource_exhausted(format!(
            "{:?} has {limit} jobs that have not ended, the most that --max-jobs-per-user allows; wait for some to end, or \
             cancel some",
            caller.name
        )))
    }

    fn room(&self, name: &Arc<str>, limit: usize) -> Option<Room> {
        self.with(name, |jobs| {
            let free = jobs.active.len() + jobs.under_way < limit;
            jobs.under_way += usize::from(free);
            free.then(|| Room {
                jobs: self.clone(),
                name: Arc::clone(name),
            })
        })
    }

    fn active(&self, name: &Arc<str>) -> Vec<JobId> {
        self.with(name, |jobs| jobs.active.iter().copied().collect())
    }

    fn with<T>(&self, name: &Arc<str>, act: impl FnOnce(&mut Jobs) -> T) -> T {
        let mut all = self.0.lock().expect("no panic while locked");
        act(all.entry(Arc::clone(name)).or_default())
    }
}

/// Room for a job, until it is used or dropped.
pub(crate) struct Room {
    jobs: UserJobs,
    name: Arc<str>,
}

impl Room {
    /// The job that was submitted.
    pub(crate) fn filled(self, job: JobId) {
        self.jobs.with(&self.name, |jobs| jobs.active.insert(job));
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.jobs.with(&self.name, |jobs| jobs.under_way -= 1);
    }
}
