//! The state of the core, and how it is loaded from the catalog.
//!
//! Each part has private fields, and the methods that need only that part. `Core` has the methods
//! that need two, in one file for each subject.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::{Changes, Job, ResultSet, Settled, Snapshot, StageRecord, Timing};
use picofarm_proto::ids::{JobId, RangeId, StageRef};

use super::{
    doubts::Doubts,
    failing_workers::FailingWorkers,
    leases::Leases,
    load::Load,
    message::{SessionId, ToWorker},
    outcome::Outcome,
    peers::Peers,
    pools::Pools,
    refunds::Refunds,
    second_runs::SecondRuns,
    settings::{MakeId, Settings, UserQuotas},
    stages::Stages,
    store_faults::StoreFaults,
    workers::Workers,
};

/// The state of this instance.
pub(crate) struct Core {
    pub(super) settings: Settings,
    /// Stages of active jobs, with the ranges held.
    pub(super) stages: Stages,
    /// Connected workers.
    pub(super) workers: Workers,
    /// The stage of each leased range, and the progress of its tasks.
    pub(super) leases: Leases,
    /// Which workers run which job.
    pub(super) load: Load,
    /// The bounds on users.
    pub(super) quotas: UserQuotas,
    /// Bytes that the jobs of each bounded user have published.
    pub(super) published: BTreeMap<String, u64>,
    /// Tasks that run a second time.
    pub(super) second_runs: SecondRuns,
    /// Unavailable stores for which tasks wait.
    pub(super) store_faults: StoreFaults,
    /// Workers that are not trusted, and doubtful results.
    pub(super) doubts: Doubts,
    /// Workers on which every task fails.
    pub(super) failing_workers: FailingWorkers,
    /// The charges against each disconnected worker.
    pub(super) refunds: Refunds,
    /// Other instances.
    pub(super) peers: Peers,
    /// Pools of workers that other programs start.
    pub(super) pools: Pools,
    /// Changes to commit, and messages to send.
    pub(super) outcome: Outcome,
}

impl Core {
    /// Restores the state from the catalog. Live leases get a new period, so that workers that
    /// reconnect keep them. `timings` contains the known timing of each result set of an active
    /// job.
    pub(crate) fn load(
        snapshot: Snapshot,
        timings: &HashMap<ResultSet, Timing>,
        settings: Settings,
        make_id: MakeId,
        now_ms: i64,
    ) -> Self {
        let names = snapshot.workers.into_iter().map(|w| (w.id, w.name));
        let mut core = Self {
            settings,
            stages: Stages::default(),
            workers: Workers::with_names(names),
            leases: Leases::default(),
            load: Load::default(),
            quotas: UserQuotas::default(),
            published: BTreeMap::new(),
            second_runs: SecondRuns::default(),
            store_faults: StoreFaults::default(),
            doubts: Doubts::default(),
            failing_workers: FailingWorkers::default(),
            refunds: Refunds::default(),
            peers: Peers::default(),
            pools: Pools::default(),
            outcome: Outcome::new(make_id),
        };
        for job in snapshot.jobs {
            core.add_job(&job, job.stages(), timings);
        }
        core.receive(snapshot.owned, now_ms);
        core
    }

    /// Returns whether a job is known to be active.
    pub(crate) fn knows(&self, job: JobId) -> bool {
        self.stages.contains_job(job)
    }

    /// Adds an active job with its stages.
    pub(crate) fn add_job(
        &mut self,
        job: &Job,
        stages: Vec<StageRecord>,
        timings: &HashMap<ResultSet, Timing>,
    ) {
        self.stages.add_job(job, stages, timings);
        self.load.job_added(job);
    }

    /// Opens stages that may begin and removes jobs that have ended.
    pub(crate) fn settled(&mut self, settled: &Settled) {
        for id in &settled.opened {
            if let Some(entry) = self.stages.get_mut(id) {
                entry.ask_again();
                entry.ask_not_before(0);
            }
        }
        for end in &settled.ends {
            tracing::info!(job = %end.job, state = ?end.state, "job ended");
            self.stages.remove_job(end.job);
            self.load.job_removed(end.job);
        }
    }

    /// Returns the changes to commit, and the messages to send after the commit.
    pub(crate) fn take(&mut self) -> (Changes, Vec<(SessionId, ToWorker)>) {
        self.outcome.take()
    }

    /// Extends every lease by one period from now. Used after a stall of the coordinator, because
    /// no worker is at fault then.
    pub(crate) fn grace(&mut self, now_ms: i64) {
        let leases: Vec<RangeId> = self.leases.iter().map(|(id, _)| id).collect();
        for range in leases {
            self.renew(range, now_ms);
        }
        let until_ms = now_ms + i64::from(self.settings.lease_ms);
        self.leases.grace_until(until_ms);
    }

    /// Marks a stage as possibly finished if none of its tasks is held by this instance.
    pub(super) fn perhaps_over(&mut self, stage: StageRef, now_ms: i64) {
        let empty = self.stages.get(&stage).is_none_or(|e| e.held.is_empty());
        if empty {
            self.outcome.perhaps_over(stage, now_ms);
        }
    }
}
