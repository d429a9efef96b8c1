//! Derives a job's tasks and which of them run, given the existing outputs. Pure.

use std::collections::BTreeSet;

use picofarm_catalog::{Job, Range, RangeState, Run};
use picofarm_proto::{
    ids::{Epoch, JobId, RangeId, StageRef},
    messages::{JobPlan, StagePlan},
    spec::{JobSpec, StageSpec, matrix::of_matrix, memory::peak_bytes},
};
use serde_json::Value;

/// Returns the ranges of a new stage: a done range for each run of existing outputs, and a pending
/// one for each gap. `existing` is ascending and disjoint.
pub fn expand(
    stage: StageRef,
    count: u64,
    existing: &[Run],
    ids: &mut dyn FnMut() -> RangeId,
) -> Vec<Range> {
    let mut ranges = Vec::with_capacity(2 * existing.len() + 1);
    let mut push = |lo: u64, hi: u64, state| {
        if lo < hi {
            ranges.push(Range {
                id: ids(),
                stage,
                lo,
                hi,
                epoch: Epoch(0),
                crashes: 0,
                state,
            });
        }
    };
    let mut at = 0;
    for run in existing {
        let (lo, hi) = (run.lo.min(count), run.hi.min(count));
        push(at, lo, RangeState::Pending { not_before_ms: 0 });
        push(lo, hi, RangeState::Done { reused: true });
        at = hi;
    }
    push(at, count, RangeState::Pending { not_before_ms: 0 });
    ranges
}

/// Threads of the worker assumed for a plan's memory estimate. Each has some megabytes of its own.
const THREADS: u32 = 8;

/// The known state of a stage's outputs.
#[derive(Debug, Clone, Default)]
pub struct Outputs {
    /// Those of exactly its settings that count.
    pub there: Vec<Run>,
    /// How many others something is known of, which says why their tasks run.
    pub explained: u64,
}

/// Returns the effect of submitting `spec`, given its hash, the known state of each stage's
/// outputs, the job
/// that has this spec, and recent jobs, latest first, to compare with.
pub fn plan(
    spec: &JobSpec,
    hash: &str,
    outputs: &[Outputs],
    existing_job: Option<JobId>,
    recent: &[Job],
) -> JobPlan {
    let mut stages = Vec::with_capacity(spec.stages.len());
    for (position, (stage, outputs)) in spec.stages.iter().zip(outputs).enumerate() {
        let memory = peak_bytes(&stage.task, &spec.known(position), THREADS);
        let total = stage.tasks();
        let there: u64 = outputs
            .there
            .iter()
            .map(|r| r.hi.min(total) - r.lo.min(total))
            .sum();
        let reuse = if stage.force { 0 } else { there };
        stages.push(StagePlan {
            name: stage.name.clone(),
            kind: stage.task.kind().to_owned(),
            total,
            reuse,
            taken: 0,
            run: total - reuse,
            memory_bytes: memory.unwrap_or(0),
            workers: 0,
            task_seconds: None,
            task_bytes: None,
            measured: false,
            reasons: reasons(stage, total, (there, outputs.explained), recent),
        });
    }
    JobPlan {
        spec_hash: hash.to_owned(),
        total: stages.iter().map(|s| s.total).sum(),
        reuse: stages.iter().map(|s| s.reuse).sum(),
        taken: 0,
        run: stages.iter().map(|s| s.run).sum(),
        existing_job,
        stages,
        warnings: Vec::new(),
    }
}

/// Why tasks of a stage run or do not, given how many outputs there are, and of how many more it is
/// known why they do not count.
fn reasons(
    stage: &StageSpec,
    total: u64,
    (there, explained): (u64, u64),
    recent: &[Job],
) -> Vec<String> {
    let mut reasons = Vec::new();
    if stage.force {
        let what = "all run: the stage is forced; each result must equal the one that exists";
        return vec![what.to_owned()];
    }
    if there > 0 {
        reasons.push(format!(
            "{there} of {total} outputs exist for exactly these settings: reused"
        ));
    }
    let run = (total - there).saturating_sub(explained);
    if run > 0 && there + explained > 0 {
        reasons.push(format!("{run} run: their outputs do not exist yet"));
    } else if run > 0 {
        reasons.push(match kin(stage, recent) {
            Some(kin) if kin.changes.is_empty() => {
                let what = match kin.same_place {
                    true => "whose outputs are not there (not made yet, or removed)",
                    false => "but it put its results elsewhere",
                };
                format!(
                    "{run} run: the settings are those of job {}, {what}",
                    kin.job
                )
            }
            Some(kin) => {
                let changes = kin.changes.join(", ");
                format!("{run} run: since job {}, {changes}", kin.job)
            }
            None => format!("{run} run: no job has done the like of it"),
        });
    }
    reasons
}

/// A stage of an earlier job that resembles the submitted one.
struct Kin {
    job: JobId,
    /// Descriptions of the settings that have changed since.
    changes: Vec<String>,
    /// Whether its results are in the place of the new stage's results.
    same_place: bool,
}

/// Returns the most similar earlier stage, preferring the same place and then the latest. Stages
/// are similar if they have the same name or come from the same matrix.
fn kin(stage: &StageSpec, recent: &[Job]) -> Option<Kin> {
    let base = |stage: &StageSpec| of_matrix(&stage.name).unwrap_or(&stage.name).to_owned();
    let place = |stage: &StageSpec| {
        let results = stage.task.results();
        (results.store.to_owned(), results.folder)
    };
    let stages = recent
        .iter()
        .flat_map(|job| job.spec.stages.iter().map(|other| (job.id, other)));
    stages
        .filter(|(_, other)| other.task.kind() == stage.task.kind() && base(other) == base(stage))
        .map(|(job, other)| Kin {
            job,
            changes: changes(other, stage),
            same_place: place(other) == place(stage),
        })
        .min_by_key(|kin| (kin.changes.len(), !kin.same_place))
}

/// Returns the settings that affect results and differ between two stages of one kind, in the form
/// `render.bins is 300 and was 637`.
pub fn changes(was: &StageSpec, is: &StageSpec) -> Vec<String> {
    let (was, is) = (shaping(was), shaping(is));
    let mut changes = Vec::new();
    differences(&mut changes, String::new(), Some(&was), Some(&is));
    changes
}

/// Returns everything in a stage that affects its results, as one tree.
fn shaping(stage: &StageSpec) -> Value {
    let mut tree = serde_json::to_value(&stage.task).expect("settings are plain data");
    tree["count"] = Value::Null;
    tree["output"] = tree["output"]["profile"].take();
    if let Some(scenes) = tree.get_mut("scenes").and_then(Value::as_object_mut) {
        scenes.remove("count");
        if let Some(files) = scenes.get_mut("files").and_then(Value::as_array_mut) {
            for file in files {
                *file = file["sha256"].take();
            }
        }
    }
    tree
}

/// Most differences listed.
const MOST_LINES: usize = 8;

fn differences(lines: &mut Vec<String>, path: String, was: Option<&Value>, is: Option<&Value>) {
    if was == is || lines.len() >= MOST_LINES {
        return;
    }
    if let (Some(Value::Object(a)), Some(Value::Object(b))) = (was, is) {
        let names: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
        for name in names {
            let dot = if path.is_empty() { "" } else { "." };
            let path = format!("{path}{dot}{name}");
            differences(lines, path, a.get(name), b.get(name));
        }
        return;
    }
    if let (Some(Value::Array(a)), Some(Value::Array(b))) = (was, is)
        && a.len().max(b.len()) > MOST_LINES
    {
        let equal = a.iter().zip(b).filter(|(a, b)| a == b).count();
        let (changed, others) = (b.len() - equal, a.len());
        lines.push(format!(
            "{changed} of {} {path} differ ({others} before)",
            b.len()
        ));
        return;
    }
    let text = |v: Option<&Value>| v.map_or("unset".into(), ToString::to_string);
    lines.push(format!("{path} is {} and was {}", text(is), text(was)));
}

#[cfg(test)]
mod tests {
    use picofarm_proto::spec::{PromoteSettings, PromoteTask, SourceSettings, TaskSpec};

    use super::*;

    #[test]
    fn a_stage_without_a_version_gets_an_error_about_itself() {
        let promote = PromoteTask {
            source: Some(SourceSettings {
                store: "s".into(),
                dataset: "d".into(),
            }),
            count: 1,
            promote: PromoteSettings {
                model: "best".into(),
                among: vec!["a".into()],
                store: String::new(),
                tolerate_missing: false,
                version: String::new(),
            },
        };
        let stage = StageSpec::new(TaskSpec::Promote(promote));
        let said = stage.check_resolved().unwrap_err().to_string();
        assert!(
            said.contains("promote.version") && said.contains("kind \"promote\""),
            "{said}"
        );
    }
}
