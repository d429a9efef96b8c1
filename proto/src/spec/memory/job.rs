//! The memory of a job's tasks, derived from the stages before them.

use super::{known::Known, network::Network, shape::Shape};
use crate::spec::{JobSpec, StageSpec, TaskSpec};

/// Returns the most bytes that a task takes in a process of its own; `None` if that depends on an
/// unknown data set.
///
/// Each kind computes its own estimate (`memory` in `kinds/`), in addition to the program (70 MB)
/// and the store (60 MB).
pub fn peak_bytes(task: &TaskSpec, known: &Known, threads: u32) -> Option<u64> {
    let estimate = task.memory(known, threads)?;
    // The cast saturates.
    Some(estimate as u64)
}

impl JobSpec {
    /// Returns the known properties of the inputs of the stage at a position, from the stages that
    /// make them.
    pub fn known(&self, stage: usize) -> Known {
        let before = &self.stages[..stage.min(self.stages.len())];
        let Some(spec) = self.stages.get(stage) else {
            return Known::default();
        };
        Known {
            source: spec
                .task
                .reads()
                .and_then(|source| made(before, (&source.store, &source.dataset))),
            networks: networks(before, spec),
        }
    }
}

/// Returns the scenes that a stage puts into a place.
pub(super) fn made(before: &[StageSpec], place: (&String, &String)) -> Option<Shape> {
    let at = before.iter().rposition(|s| s.task.makes() == Some(place))?;
    let source = before[at].task.reads();
    let source = source.and_then(|source| made(&before[..at], (&source.store, &source.dataset)));
    before[at].task.shape(source)
}

/// Returns the networks of the models that a stage reads, as far as earlier stages train them.
fn networks(before: &[StageSpec], spec: &StageSpec) -> Vec<Network> {
    let Some(store) = spec.task.models_store() else {
        return Vec::new();
    };
    let trained = |model: &String| {
        let at = before
            .iter()
            .rposition(|s| s.task.trains() == Some((store, model)))?;
        let source = before[at].task.reads()?;
        let scenes = made(&before[..at], (&source.store, &source.dataset))?;
        before[at].task.network(&scenes)
    };
    let models = spec.task.models();
    models
        .iter()
        .filter_map(|(_, model)| trained(model))
        .collect()
}
