//! `picofarm job check`: checks a job file without a coordinator.

use std::path::Path;

use picofarm_proto::spec::{JobSpec, StageSpec, matrix};
use serde_json::json;

use crate::output::{Output, table};

/// Shows the stages of a job that was read and checked.
pub fn show(file: &Path, spec: &JobSpec, output: Output) {
    let tasks = spec.stages.iter().map(StageSpec::tasks).sum::<u64>();
    let stages: Vec<_> = spec
        .stages
        .iter()
        .map(|s| json!({"name": s.name, "kind": s.task.kind(), "tasks": s.tasks()}))
        .collect();
    output.result(
        &json!({"name": spec.name, "tasks": tasks, "stages": stages}),
        || {
            let header = ["stage", "kind", "tasks"].map(String::from).to_vec();
            let groups = spec.stages.chunk_by(|a, b| {
                a.task.kind() == b.task.kind() && matrix::same_matrix(&a.name, &b.name)
            });
            let rows = groups.map(|stages| {
                let names: Vec<&str> = stages.iter().map(|stage| &*stage.name).collect();
                let name = match stages.len() {
                    1 => stages[0].name.to_string(),
                    count => format!("{} ({count} stages)", matrix::together(&names)),
                };
                let tasks = stages.iter().map(StageSpec::tasks).sum::<u64>();
                vec![name, stages[0].task.kind().to_string(), tasks.to_string()]
            });
            let rows: Vec<_> = std::iter::once(header).chain(rows).collect();
            let found = format!("{}: no fault found, {tasks} tasks\n", file.display());
            found + &table(&rows)
        },
    );
}
