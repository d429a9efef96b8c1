//! Pauses jobs, ends them, and makes their given-up tasks pending again.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::{Job, Range, ResultSet, StageRecord, Timing};
use picofarm_proto::ids::{JobId, RangeId, WorkerId};

use super::{message::ToWorker, state::Core, transition::RangeEvent};

/// A job to be added to the core.
#[derive(Debug, Clone)]
pub(crate) struct NewJob {
    pub job: Job,
    pub stages: Vec<StageRecord>,
    /// Timings of the job's result sets.
    pub timings: Timings,
    /// Memory used by the job's spec.
    pub kept: u64,
}

/// The known timings of result sets.
pub(crate) type Timings = HashMap<ResultSet, Timing>;

impl Core {
    /// Pauses or resumes a job. A paused job's tasks that no worker has begun go back; running
    /// tasks continue.
    pub(crate) fn paused(&mut self, job: JobId, paused: bool) {
        if paused {
            self.return_waiting(job);
        }
        for (_, entry) in self.stages.iter_mut().filter(|(id, _)| id.job == job) {
            entry.set_paused(paused);
            entry.ask_again();
            if paused {
                entry.held.give_pending(self.outcome.changes());
            }
        }
    }

    /// Takes back the tasks of a job's leases that their workers have not begun, as far as is
    /// known. A worker begins the tasks of a lease in order.
    fn return_waiting(&mut self, job: JobId) {
        let stages = self.stages.iter().filter(|(id, _)| id.job == job);
        let leases = stages.flat_map(|(_, entry)| entry.held.leased());
        let leases: Vec<(Range, WorkerId)> = leases
            .map(|(range, lease)| (range.clone(), lease.worker))
            .collect();
        for (range, worker) in leases {
            let Some(entry) = self.workers.get(&worker) else {
                continue;
            };
            let session = entry.session;
            let busy = |id: &RangeId| self.leases.is_running(*id);
            let elsewhere = entry.leases.iter().any(|id| *id != range.id && busy(id));
            if elsewhere && !busy(&range.id) {
                self.outcome
                    .revoke(session, range.lease(), "the job is held");
                self.close(&range, false);
                continue;
            }
            let Some(last) = self.running_tasks(&range).into_iter().max() else {
                continue;
            };
            let at = last + 1;
            if at < range.hi && (at..range.hi).all(|task| range.has_to_do(task)) {
                let lease = range.lease();
                self.outcome.send(session, ToWorker::Trim { lease, hi: at });
                self.mark(&range, &RangeEvent::Trim { at });
            }
        }
    }

    /// Returns the jobs that have passed their deadline.
    pub(crate) fn overdue(&self, now_ms: i64) -> BTreeMap<JobId, String> {
        let late = self.stages.iter();
        let late = late.filter(|(_, entry)| entry.is_overdue(now_ms));
        late.map(|(id, entry)| (id.job, entry.job_spec().limits.deadline.clone()))
            .collect()
    }

    /// Removes a job after it has ended. Its leases are revoked, and its unfinished tasks go
    /// back to the catalog.
    pub(crate) fn drop_job(&mut self, job: JobId, reason: &str) {
        for id in self.stages.ids_of(job) {
            let leases: Vec<_> = self.stages[&id]
                .held
                .leased()
                .map(|(range, lease)| (range.clone(), lease.worker))
                .collect();
            for (range, worker) in leases {
                if let Some(entry) = self.workers.get(&worker) {
                    self.outcome
                        .revoke(entry.session, range.lease(), reason.to_owned());
                }
                self.close(&range, false);
            }
            if let Some(mut entry) = self.stages.remove(id) {
                entry.held.give_pending(self.outcome.changes());
            }
        }
        self.load.job_removed(job);
    }

    /// Makes the given-up tasks of an active job pending again.
    pub(crate) fn retried(&mut self, job: JobId) {
        for (_, entry) in self.stages.iter_mut().filter(|(id, _)| id.job == job) {
            entry.forget_exceptions();
            entry.ask_again();
        }
    }
}
