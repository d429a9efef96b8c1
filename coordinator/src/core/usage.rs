//! Counts the use of workers, for the job of the lease under which a task ran. A result that was
//! found in the store costs nothing, and an attempt that nobody reports is not counted.

use picofarm_catalog::day_of;
use picofarm_proto::{
    ids::{StageRef, WorkerId},
    messages::{Failure, FailureKind, Finished, Usage},
};

use super::state::Core;

/// The largest amount that one report can add, so that no report makes a sum overflow.
const MOST: u64 = 1 << 50;

impl Core {
    /// Counts a computed task.
    pub(super) fn count_task(
        &mut self,
        id: StageRef,
        by: WorkerId,
        report: &Finished,
        now_ms: i64,
    ) {
        let ms = (report.seconds * 1000.0).round() as u64;
        let usage = Usage {
            tasks: 1,
            bytes: report.bytes.min(MOST),
            core_ms: self.core_ms(by, ms, report.shared),
            failures: 0,
        };
        self.outcome.record_usage(day_of(now_ms), id.job, usage);
        let user = self.stages.get(&id).map(|entry| entry.job().user.clone());
        if let Some(user) = user {
            self.add_published(&user, usage.bytes);
        }
    }

    /// Counts a failed attempt.
    pub(super) fn count_failure(
        &mut self,
        id: StageRef,
        by: WorkerId,
        report: &Failure,
        now_ms: i64,
    ) {
        let failed = matches!(report.kind, FailureKind::User | FailureKind::Crash);
        let usage = Usage {
            failures: u64::from(failed),
            core_ms: self.core_ms(by, report.milliseconds, report.shared),
            ..Usage::default()
        };
        self.outcome.record_usage(day_of(now_ms), id.job, usage);
    }

    /// Returns a task's part of a worker's cores during `ms` milliseconds.
    fn core_ms(&self, worker: WorkerId, ms: u64, shared: u32) -> u64 {
        let cores = self.workers.get(&worker).map_or(1, |w| w.abilities.cores);
        let all = ms.saturating_mul(u64::from(cores.max(1)));
        (all / u64::from(shared.max(1))).min(MOST)
    }
}
