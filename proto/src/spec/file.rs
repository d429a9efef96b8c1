//! The written form of a job in a TOML file, in the catalog and on the wire. Unknown fields are
//! refused.
//!
//! A job that only renders may omit `[[stage]]` and put `[scenes]`, `[render]`, `[output]` and
//! `[resources]` at the top level. In a stage, `kind` defaults to `render` and `name` to the kind.
//! `source` may name a stage, and then means its data set. A stage needs the stages that make its
//! input data. The number of scenes of a data set that another stage makes may be omitted.
//!
//! `parts = 8` next to `[render]` divides each scene into that many tasks and one for the light
//! paths, and joins them. The job gets a stage of kind `part`, called `NAME.parts`, before the
//! render stage. Likewise, `shards = 8` in an evaluation adds `NAME.shards`, of kind
//! `evaluate_shard`.
//!
//! `matrix = { dark = [0.0, 0.1], bins = [1, 4] }` makes a stage for each combination of values.
//! Anywhere in the stage, the text `"{dark}"` becomes the value, and `{dark}` inside a longer text
//! becomes the value's text. An instance is called `name[0.1,4]`, with values in the order of the
//! parameters' names; `needs = ["name"]` means all instances. `[stage.sweep]` is similar, for
//! trainings from which the best is chosen ([`super::sweep`]).

use serde::Deserialize;
use serde_json::Value;

use super::{
    EvaluateShardTask, PartTask, RenderTask, TaskSpec,
    limits::{Limits, MAX_STAGES, Resources},
    matrix,
    places::OutputSettings,
    render::{RenderSettings, SceneSource},
    spec_error::SpecError,
    stage::StageSpec,
    sweep,
};

/// The number, the name or the id of another job.
#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "expected the number, the name or the id of a job"
)]
pub(super) enum JobName {
    Number(u64),
    Text(String),
}

impl From<JobName> for String {
    fn from(name: JobName) -> Self {
        match name {
            JobName::Number(number) => number.to_string(),
            JobName::Text(text) => text,
        }
    }
}

/// A job file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JobText {
    pub(super) name: String,
    #[serde(default)]
    pub(super) priority: i32,
    #[serde(default)]
    pub(super) limits: Limits,
    #[serde(default)]
    pub(super) nonce: String,
    #[serde(default)]
    pub(super) project: String,
    #[serde(default)]
    pub(super) after: Vec<JobName>,
    #[serde(default)]
    resources: Resources,
    scenes: Option<SceneSource>,
    render: Option<RenderSettings>,
    output: Option<OutputSettings>,
    parts: Option<u32>,
    #[serde(default)]
    stage: Vec<Value>,
}

impl JobText {
    /// Takes the stages in their written form, without the values that follow from other stages.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first field that cannot be read.
    pub(super) fn stages(&mut self) -> Result<Vec<StageSpec>, SpecError> {
        let mut stages = Vec::new();
        let missing = |field: &str, what: &str| {
            SpecError::new(
                field,
                format!("is missing; {what}, or list stages ([[stage]])"),
            )
        };
        if self.stage.is_empty() {
            let scenes = self.scenes.take();
            let output = self.output.take();
            let task = RenderTask::new(
                scenes.ok_or_else(|| missing("scenes", "say which scenes are rendered"))?,
                self.render.take().unwrap_or_default(),
                output.ok_or_else(|| missing("output", "say where results go"))?,
                self.parts,
            );
            stages.push(StageSpec {
                resources: std::mem::take(&mut self.resources),
                ..StageSpec::new(TaskSpec::Render(task))
            });
        } else {
            for (field, given) in [
                ("scenes", self.scenes.is_some()),
                ("render", self.render.is_some()),
                ("output", self.output.is_some()),
                ("parts", self.parts.is_some()),
                ("resources", !self.resources.is_none()),
            ] {
                if given {
                    let what = "belongs into a [[stage]] where there are any; move it there";
                    return Err(SpecError::new(field, what));
                }
            }
            for (i, stage) in std::mem::take(&mut self.stage).into_iter().enumerate() {
                for instance in matrix::instances(stage)? {
                    let at = |e: SpecError| SpecError::new(format!("stage[{i}]"), e.to_string());
                    for stage in sweep::trials(instance)? {
                        stages.push(StageSpec::try_from(stage).map_err(at)?);
                    }
                }
                if stages.len() > MAX_STAGES {
                    let what = format!("there are more than {MAX_STAGES}; make the matrix smaller");
                    return Err(SpecError::new("stage", what));
                }
            }
        }
        Ok(divided(stages))
    }
}

/// Inserts a stage that makes the parts before each stage that joins them, unless it exists
/// already.
fn divided(written: Vec<StageSpec>) -> Vec<StageSpec> {
    let mut stages: Vec<StageSpec> = Vec::with_capacity(written.len());
    for mut stage in written {
        if let Some((suffix, task)) = parts_of(&stage.task) {
            let name = format!("{}.{suffix}", stage.name);
            if !stages.iter().any(|s| s.name == name) {
                stages.push(StageSpec {
                    name: name.clone(),
                    task,
                    ..stage.clone()
                });
            }
            if !stage.needs.contains(&name) {
                stage.needs.push(name);
            }
        }
        stages.push(stage);
    }
    stages
}

/// Returns the tasks that make the inputs of a joining stage, and the suffix of their stage's name.
fn parts_of(task: &TaskSpec) -> Option<(&'static str, TaskSpec)> {
    match task {
        TaskSpec::Render(task) if task.parts > 1 => {
            let whole = task.clone();
            Some(("parts", PartTask { whole }.into()))
        }
        TaskSpec::Evaluate(task) if task.evaluate.shards > 1 => {
            let whole = task.clone();
            Some(("shards", EvaluateShardTask { whole }.into()))
        }
        _ => None,
    }
}
