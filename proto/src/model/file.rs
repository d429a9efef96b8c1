//! How a job is written, in a TOML file, in the catalog and on the wire: every field known, every other one refused.
//!
//! A job that only renders may leave `[[stage]]` away and put `[scenes]`, `[render]`, `[output]` and `[resources]` at the
//! top. In a stage, `kind` is `render` and `name` is the kind unless they are given; `source` may be the name of a stage,
//! whose data set is read then; a stage needs those whose data it reads; and the number of scenes of a data set that
//! another stage makes need not be said.
//!
//! `parts = 8` beside `[render]` divides each scene among that many tasks and the light paths' one, and joins them: the
//! job gets a stage of kind `part`, called `NAME.parts`, before the render stage.
//!
//! `matrix = { dark = [0.0, 0.1], bins = [1, 4] }` makes a stage for each combination of values. Anywhere in the stage,
//! the text `"{dark}"` stands for the value, and `{dark}` inside a text for its text. An instance is called
//! `name[0.1,4]`, values in the order of the parameters' names; `needs = ["name"]` means all of them. `[stage.sweep]` does
//! the like for trainings among which the best is wanted ([`super::sweep`]).

use serde::Deserialize;
use serde_json::{Map, Value};

use super::{
    PartTask, RenderTask, TaskSpec,
    job::{
        JobSpec, Limits, MAX_STAGES, OutputSettings, Resources, SourceSettings, SpecError,
        StageSpec,
    },
    kinds::Fields,
    refer,
    render::{RenderSettings, SceneSource},
    sweep,
};

/// A job file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JobText {
    name: String,
    #[serde(default)]
    priority: i32,
    #[serde(default)]
    limits: Limits,
    #[serde(default)]
    nonce: String,
    #[serde(default)]
    project: String,
    #[serde(default)]
    resources: Resources,
    scenes: Option<SceneSource>,
    render: Option<RenderSettings>,
    output: Option<OutputSettings>,
    parts: Option<u32>,
    #[serde(default)]
    stage: Vec<Value>,
}

/// A stage's name, or a place.
#[derive(Deserialize)]
#[serde(untagged)]
enum SourceText {
    Stage(String),
    Place(PlaceText),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlaceText {
    store: String,
    dataset: String,
}

/// Until [`JobText`] is read as a whole, a source without a store names a stage.
impl<'de> Deserialize<'de> for SourceSettings {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = SourceText::deserialize(deserializer).map_err(|_| {
            serde::de::Error::custom(
                "a source is a stage's name or { store = \"…\", dataset = \"…\" }",
            )
        })?;
        Ok(match text {
            SourceText::Stage(name) => Self {
                store: String::new(),
                dataset: name,
            },
            SourceText::Place(PlaceText { store, dataset }) => Self { store, dataset },
        })
    }
}

impl TryFrom<JobText> for JobSpec {
    type Error = SpecError;

    fn try_from(text: JobText) -> Result<Self, SpecError> {
        let mut stages = Vec::new();
        let missing = |field: &str, what: &str| {
            SpecError::new(
                field,
                format!("is missing; {what}, or list stages ([[stage]])"),
            )
        };
        if text.stage.is_empty() {
            let task = RenderTask {
                scenes: text
                    .scenes
                    .ok_or_else(|| missing("scenes", "say which scenes are rendered"))?,
                render: text.render.unwrap_or_default(),
                output: text
                    .output
                    .ok_or_else(|| missing("output", "say where results go"))?,
                parts: text.parts.unwrap_or(1),
            };
            stages.push(StageSpec {
                resources: text.resources,
                ..StageSpec::new(TaskSpec::Render(task))
            });
        } else {
            for (field, given) in [
                ("scenes", text.scenes.is_some()),
                ("render", text.render.is_some()),
                ("output", text.output.is_some()),
                ("parts", text.parts.is_some()),
                ("resources", !text.resources.is_none()),
            ] {
                if given {
                    let what = "belongs into a [[stage]] where there are any; move it there";
                    return Err(SpecError::new(field, what));
                }
            }
            for (i, stage) in text.stage.into_iter().enumerate() {
                for instance in instances(stage)? {
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
        let mut spec = Self {
            name: text.name,
            priority: text.priority,
            limits: text.limits,
            nonce: text.nonce,
            project: text.project,
            stages,
        };
        spec.divide();
        spec.resolve()?;
        Ok(spec)
    }
}

impl JobSpec {
    /// Puts a stage that renders the parts before each stage that joins them, unless it is there already.
    fn divide(&mut self) {
        let mut stages: Vec<StageSpec> = Vec::with_capacity(self.stages.len());
        for mut stage in self.stages.drain(..) {
            if let TaskSpec::Render(task) = &stage.task
                && task.parts > 1
            {
                let name = format!("{}.parts", stage.name);
                if !stages.iter().any(|s| s.name == name) {
                    let whole = task.clone();
                    stages.push(StageSpec {
                        name: name.clone(),
                        task: TaskSpec::Part(PartTask {
                            whole,
                            joined_by: String::new(),
                        }),
                        ..stage.clone()
                    });
                }
                if !stage.needs.contains(&name) {
                    stage.needs.push(name);
                }
            }
            stages.push(stage);
        }
        self.stages = stages;
    }

    /// Fills in what follows from other stages: places, needs and numbers of scenes.
    ///
    /// # Errors
    /// A source that no stage before makes.
    pub fn resolve(&mut self) -> Result<(), SpecError> {
        for i in 0..self.stages.len() {
            let (before, rest) = self.stages.split_at_mut(i);
            let stage = &mut rest[0];
            let mut needs = Vec::with_capacity(stage.needs.len());
            for need in stage.needs.drain(..) {
                let instance = format!("{need}[");
                let all = before.iter().map(|s| &s.name);
                let mut all = all.filter(|n| n.starts_with(&instance)).peekable();
                if before.iter().any(|s| s.name == need) || all.peek().is_none() {
                    needs.push(need);
                } else {
                    needs.extend(all.cloned());
                }
            }
            stage.needs = needs;
            let Some((source, count)) = stage.task.reads_mut() else {
                refer::link(stage, before)?;
                continue;
            };
            if source.store.is_empty() && !source.dataset.is_empty() {
                let named = before.iter().find(|s| s.name == source.dataset);
                let Some((store, dataset)) = named.and_then(|s| s.task.makes()) else {
                    return Err(SpecError::new(
                        format!("stage.{}.source", stage.name),
                        format!(
                            "{:?} is no stage before this one that makes a data set; for one that exists, write \
                             {{ store = \"…\", dataset = \"…\" }}",
                            source.dataset
                        ),
                    ));
                };
                *source = SourceSettings {
                    store: store.clone(),
                    dataset: dataset.clone(),
                };
            }
            let place = (&source.store, &source.dataset);
            if let Some(maker) = before.iter().find(|s| s.task.writes() == Some(place)) {
                if *count == 0 {
                    *count = maker.tasks();
                }
                if !stage.needs.contains(&maker.name) {
                    stage.needs.push(maker.name.clone());
                }
            }
            refer::link(stage, before)?;
        }
        Ok(())
    }
}

impl TryFrom<Value> for StageSpec {
    type Error = SpecError;

    fn try_from(value: Value) -> Result<Self, SpecError> {
        let mut fields = Fields::new(value)?;
        let name: Option<String> = fields.optional("name")?;
        Ok(Self {
            name: name.unwrap_or_else(|| fields.kind().to_owned()),
            needs: fields.or_default("needs")?,
            tolerate_dead: fields.or_default("tolerate_dead")?,
            force: fields.or_default("force")?,
            resources: fields.or_default("resources")?,
            task: TaskSpec::read(fields)?,
        })
    }
}

/// The stages that a stage with a matrix stands for; one without stands for itself.
fn instances(mut stage: Value) -> Result<Vec<Value>, SpecError> {
    let Some(matrix) = stage.as_object_mut().and_then(|s| s.remove("matrix")) else {
        return Ok(vec![stage]);
    };
    let fail = |what: &str| Err(SpecError::new("stage.matrix", what));
    let Value::Object(matrix) = matrix else {
        return fail("must be a table of lists, e.g. { dark = [0.0, 0.1] }");
    };
    let mut parameters: Vec<(String, Value)> = matrix.into_iter().collect();
    parameters.sort_by(|a, b| a.0.cmp(&b.0));
    let mut choices: Vec<Vec<(String, Value)>> = vec![vec![]];
    for (name, values) in parameters {
        let Some(values) = values.as_array().filter(|v| !v.is_empty()) else {
            return fail(&format!("{name} must be a list of at least one value"));
        };
        if choices.len() * values.len() > MAX_STAGES {
            return fail(&format!("stands for more than {MAX_STAGES} stages"));
        }
        let with = |choice: &Vec<(String, Value)>, value: &Value| {
            let mut choice = choice.clone();
            choice.push((name.clone(), value.clone()));
            choice
        };
        choices = choices
            .iter()
            .flat_map(|choice| values.iter().map(|value| with(choice, value)))
            .collect();
    }
    let instance = |choice: Vec<(String, Value)>| {
        let mut stage = stage.clone();
        let values: Vec<String> = choice.iter().map(|(_, value)| plain(value)).collect();
        if let Some(table) = stage.as_object_mut() {
            name_instance(table, &values.join(","));
        }
        for (name, value) in &choice {
            substitute(&mut stage, &format!("{{{name}}}"), value);
        }
        stage
    };
    Ok(choices.into_iter().map(instance).collect())
}

/// `name` becomes `name[values]`, unless it names its values itself.
fn name_instance(stage: &mut Map<String, Value>, values: &str) {
    let kind = stage
        .get("kind")
        .and_then(Value::as_str)
        .unwrap_or("render");
    let name = stage.get("name").and_then(Value::as_str).unwrap_or(kind);
    if !name.contains('{') {
        let name = format!("{name}[{values}]");
        stage.insert("name".into(), Value::String(name));
    }
}

pub(super) fn substitute(into: &mut Value, mark: &str, value: &Value) {
    match into {
        Value::String(text) if text == mark => *into = value.clone(),
        Value::String(text) => *text = text.replace(mark, &plain(value)),
        Value::Array(items) => items.iter_mut().for_each(|v| substitute(v, mark, value)),
        Value::Object(table) => table.values_mut().for_each(|v| substitute(v, mark, value)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

/// A value as text inside a text.
pub(super) fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}
