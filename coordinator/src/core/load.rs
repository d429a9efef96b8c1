//! Counts which workers run which job. Fair shares and limits are based on these counts.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::Job;
use picofarm_proto::ids::{JobId, RangeId, WorkerId};

/// Live leases by job and by user, updated with every grant and every end.
#[derive(Debug, Default)]
pub(super) struct Load {
    leases: HashMap<RangeId, (JobId, WorkerId)>,
    jobs: HashMap<JobId, JobLoad>,
    users: HashMap<String, UserLoad>,
    /// Cores of the workers that were connected in this life.
    cores: HashMap<WorkerId, u64>,
    /// Number of leases that began.
    turn: u64,
    /// The turn at which each active job, and each user, got the last lease or joined.
    turns_of_jobs: HashMap<JobId, u64>,
    turns_of_users: HashMap<String, u64>,
    /// Workers of other instances by job, as last reported.
    elsewhere: BTreeMap<JobId, u32>,
}

#[derive(Debug, Default)]
struct UserLoad {
    leases: u32,
    workers: BTreeMap<WorkerId, u32>,
    /// The sum over these workers.
    cores: u64,
}

#[derive(Debug, Default)]
struct JobLoad {
    user: String,
    leases: u32,
    workers: BTreeMap<WorkerId, u32>,
}

impl Load {
    /// Adds a lease that has begun.
    pub(super) fn lease_begun(&mut self, lease: RangeId, job: &Job, worker: WorkerId) {
        // A known lease may have moved to another worker.
        self.lease_over(lease);
        self.leases.insert(lease, (job.id, worker));
        let load = self.jobs.entry(job.id).or_default();
        load.user.clone_from(&job.user);
        load.leases += 1;
        *load.workers.entry(worker).or_default() += 1;
        let cores = self.cores_of(worker);
        self.users
            .entry(job.user.clone())
            .or_default()
            .begin(worker, cores);
        self.turn += 1;
        self.turns_of_jobs.insert(job.id, self.turn);
        self.turns_of_users.insert(job.user.clone(), self.turn);
    }

    /// Adds an active job. It queues behind those that wait already.
    pub(super) fn job_added(&mut self, job: &Job) {
        self.turns_of_jobs.entry(job.id).or_insert(self.turn);
        self.turns_of_users
            .entry(job.user.clone())
            .or_insert(self.turn);
    }

    /// Removes a job that is no longer active.
    pub(super) fn job_removed(&mut self, job: JobId) {
        self.turns_of_jobs.remove(&job);
    }

    /// Returns when a job got its last lease, counted in leases.
    pub(super) fn turn_of_job(&self, job: JobId) -> u64 {
        self.turns_of_jobs.get(&job).copied().unwrap_or(0)
    }

    /// Returns when a user got the last lease, counted in leases.
    pub(super) fn turn_of_user(&self, user: &str) -> u64 {
        self.turns_of_users.get(user).copied().unwrap_or(0)
    }

    /// Removes a lease that has ended.
    pub(super) fn lease_over(&mut self, lease: RangeId) {
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
        let cores = self.cores.get(&worker).copied().unwrap_or(1);
        let user = self.users.get_mut(&load.user).expect("counted as well");
        user.end(worker, cores);
        if user.leases == 0 {
            self.users.remove(&load.user);
        }
        if load.leases == 0 {
            self.jobs.remove(&job);
        }
    }

    /// Records the cores of a worker that connects.
    pub(super) fn worker_has(&mut self, worker: WorkerId, cores: u32) {
        let cores = u64::from(cores.max(1));
        let before = self.cores.insert(worker, cores).unwrap_or(1);
        for user in self.users.values_mut() {
            if user.workers.contains_key(&worker) {
                user.cores = user.cores - before + cores;
            }
        }
    }

    /// Returns the cores of a worker; 1 if they are unknown.
    pub(super) fn cores_of(&self, worker: WorkerId) -> u64 {
        self.cores.get(&worker).copied().unwrap_or(1)
    }

    /// Returns the cores of the workers with leases of a user's jobs.
    pub(super) fn cores_of_user(&self, user: &str) -> u64 {
        self.users.get(user).map_or(0, |load| load.cores)
    }

    /// Returns whether a worker has leases of a user's jobs.
    pub(super) fn works_for(&self, user: &str, worker: WorkerId) -> bool {
        let load = self.users.get(user);
        load.is_some_and(|load| load.workers.contains_key(&worker))
    }

    /// Records the workers of other instances, by job.
    pub(super) fn record_elsewhere(&mut self, workers: BTreeMap<JobId, u32>) {
        self.elsewhere = workers;
    }

    /// Returns the number of leases of a user's jobs.
    pub(super) fn leases_of_user(&self, user: &str) -> u32 {
        self.users.get(user).map_or(0, |load| load.leases)
    }

    /// Returns the number of leases of a job.
    pub(super) fn leases_of_job(&self, job: JobId) -> u32 {
        self.jobs.get(&job).map_or(0, |load| load.leases)
    }

    /// Returns the number of workers of all instances with leases of a job.
    pub(super) fn workers_of_job(&self, job: JobId) -> u64 {
        let elsewhere = self.elsewhere.get(&job).copied().unwrap_or(0);
        let here = self.jobs.get(&job).map_or(0, |load| load.workers.len());
        here as u64 + u64::from(elsewhere)
    }

    /// Returns whether a worker has leases of a job.
    pub(super) fn works(&self, job: JobId, worker: WorkerId) -> bool {
        let load = self.jobs.get(&job);
        load.is_some_and(|load| load.workers.contains_key(&worker))
    }

    /// Returns how many more workers may join a job that may have `most` workers.
    pub(super) fn room(&self, job: JobId, most: u32) -> u64 {
        u64::from(most).saturating_sub(self.workers_of_job(job))
    }

    /// Returns whether a worker may join a job that may have `most` workers. The counts of other
    /// instances are up to a second old, so that the limit can be exceeded for as long.
    pub(super) fn may_join(&self, job: JobId, worker: WorkerId, most: u32) -> bool {
        self.works(job, worker) || self.room(job, most) > 0
    }
}

impl UserLoad {
    fn begin(&mut self, worker: WorkerId, cores: u64) {
        self.leases += 1;
        let count = self.workers.entry(worker).or_default();
        *count += 1;
        if *count == 1 {
            self.cores += cores;
        }
    }

    fn end(&mut self, worker: WorkerId, cores: u64) {
        self.leases -= 1;
        let count = self.workers.get_mut(&worker);
        let count = count.expect("counted when it began");
        *count -= 1;
        if *count == 0 {
            self.workers.remove(&worker);
            self.cores -= cores;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use picofarm_proto::{messages::JobState, spec::JobSpec};
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_lease_that_begins_again_at_another_worker_is_that_workers_alone() {
        let spec: JobSpec = serde_json::from_str(
            r#"{"name": "j", "scenes": {"kind": "primitive", "count": 1}, "output": {"store": "s", "dataset": "d"}}"#,
        )
        .unwrap();
        let id = JobId::from_uuid(Uuid::from_u128(1));
        let job = Job {
            id,
            spec_hash: String::new(),
            spec: Arc::new(spec),
            state: JobState::Active,
            submitted_ms: 0,
            ended_ms: None,
            paused: false,
            user: "ada".into(),
        };
        let lease = RangeId::from_uuid(Uuid::from_u128(2));
        let worker = |n| WorkerId::from_uuid(Uuid::from_u128(n));
        let mut load = Load::default();
        load.worker_has(worker(3), 8);
        load.lease_begun(lease, &job, worker(3));
        assert_eq!(load.cores_of_user("ada"), 8);
        load.lease_begun(lease, &job, worker(4));
        assert_eq!(load.cores_of_user("ada"), 1, "it is not connected yet");
        load.worker_has(worker(4), 16);
        load.worker_has(worker(4), 4);
        assert_eq!(load.cores_of_user("ada"), 4);
        assert!(load.works_for("ada", worker(4)) && !load.works_for("ada", worker(3)));
        assert_eq!((load.leases_of_job(id), load.leases_of_user("ada")), (1, 1));
        assert!(load.may_join(id, worker(4), 1) && !load.may_join(id, worker(3), 1));
        load.lease_over(lease);
        assert_eq!((load.leases_of_job(id), load.leases_of_user("ada")), (0, 0));
        assert!(load.jobs.is_empty() && load.users.is_empty());
    }
}
