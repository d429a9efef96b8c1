//! Charges for tasks that ran on lost workers. They are refunded if the worker reconnects, because
//! then only its connection was broken.

use std::collections::HashMap;

use picofarm_proto::ids::{Incarnation, StageRef, WorkerId};

/// Most lost workers that are remembered.
const WORKERS: usize = 4096;

/// The charged tasks of each disconnected worker.
#[derive(Default)]
pub(super) struct Refunds(HashMap<WorkerId, (Incarnation, Vec<(StageRef, u64)>)>);

impl Refunds {
    /// Remembers tasks that were charged because this process of a worker was lost.
    pub(super) fn remember(
        &mut self,
        worker: WorkerId,
        incarnation: Incarnation,
        tasks: Vec<(StageRef, u64)>,
    ) {
        if self.0.len() > WORKERS {
            self.0.clear();
        }
        let entry = self.0.entry(worker).or_insert((incarnation, Vec::new()));
        if entry.0 != incarnation {
            *entry = (incarnation, Vec::new());
        }
        entry.1.extend(tasks);
    }

    /// Returns the tasks to refund when a worker connects: none if it is another process.
    pub(super) fn take(
        &mut self,
        worker: WorkerId,
        incarnation: Incarnation,
    ) -> Vec<(StageRef, u64)> {
        match self.0.remove(&worker) {
            Some((charged, tasks)) if charged == incarnation => tasks,
            _ => Vec::new(),
        }
    }
}
