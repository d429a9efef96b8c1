//! Who works on which job: what fair shares and limits are measured by.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::Job;
use picofarm_proto::ids::{JobId, RangeId, WorkerId};

/// Leases in hand by job and by user, kept in step with every grant and every end.
#[derive(Debug, Default)]
pub(super) struct Load {
    leases: HashMap<RangeId, (JobId, WorkerId)>,
    jobs: HashMap<JobId, JobLoad>,
    users: HashMap<String, u32>,
    /// Workers of other instances, by job, as last heard.
    elsewhere: BTreeMap<JobId, u32>,
}

#[derive(Debug, Default)]
struct JobLoad {
    user: String,
    leases: u32,
    workers: BTreeMap<WorkerId, u32>,
}

impl Load {
    /// A lease has begun.
    pub(super) fn begun(&mut self, lease: RangeId, job: &Job, worker: WorkerId) {
        if self.leases.insert(lease, (job.id, worker)).is_some() {
            return;
        }
        let load = self.jobs.entry(job.id).or_default();
        load.user.clone_from(&job.user);
        load.leases += 1;
        *load.workers.entry(worker).or_default() += 1;
        *self.users.entry(job.user.clone()).or_default() += 1;
    }

    /// A lease has ended.
    pub(super) fn over(&mut self, lease: RangeId) {
        let Some((job, worker)) = self.leases.remove(&lease) else {
            return;
        };
        let load = self.jobs.get_mut(&job).expect("counted when it began");
        load.leases -= 1;
        let count = load.workers.get_mut(&worker).expect("counted as well");
        *count -= 1;
        if *count == 0 {
            load.workers.remove(&worker);
        }
        let user = self.users.get_mut(&load.user).expect("counted as well");
        *user -= 1;
        if *user == 0 {
            self.users.remove(&load.user);
        }
        if load.leases == 0 {
            self.jobs.remove(&job);
        }
    }

    /// Takes note of other instances' workers, by job.
    pub(super) fn hear_elsewhere(&mut self, workers: BTreeMap<JobId, u32>) {
        self.elsewhere = workers;
    }

    /// Leases of a user's jobs.
    pub(super) fn of_user(&self, user: &str) -> u32 {
        self.users.get(user).copied().unwrap_or(0)
    }

    /// Leases of a job.
    pub(super) fn of_job(&self, job: JobId) -> u32 {
        self.jobs.get(&job).map_or(0, |load| load.leases)
    }

    /// Whether a worker may join those that work on a job, of which there may be `most`. Of other instances' workers it is
    /// known how many there were a second ago: for so long there may be more.
    pub(super) fn may_join(&self, job: JobId, worker: WorkerId, most: u32) -> bool {
        let elsewhere = self.elsewhere.get(&job).copied().unwrap_or(0);
        let (known, here) = self.jobs.get(&job).map_or((false, 0), |load| {
            (load.workers.contains_key(&worker), load.workers.len())
        });
        known || here as u64 + u64::from(elsewhere) < u64::from(most)
    }
}
