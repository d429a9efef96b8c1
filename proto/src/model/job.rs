//! A job: a graph of stages, each of them many tasks of one kind. The TOML job file has exactly these fields; see
//! [`JobSpec::check`] for their limits, and [`super::file`] for what may be left out or written shorter.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::{RenderTask, TaskSpec, bounds, file::JobText};

/// Most tasks in one job.
pub const MAX_TASKS: u64 = 100_000_000;
/// Folder of a store in which trained models are kept.
pub const MODELS: &str = "models";
/// Folder of a store in which reports about them are kept.
pub const REPORTS: &str = "reports";
/// Most stages in one job.
pub const MAX_STAGES: usize = 1_000;

/// A field of a job that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {what}")]
pub struct SpecError {
    /// The field, as in the job file, e.g. `render.bin_width_m`.
    pub field: String,
    /// What was expected and how to correct it.
    pub what: String,
}

impl SpecError {
    /// An error at `field`.
    pub fn new(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self {
            field: field.into(),
            what: what.into(),
        }
    }
}

/// Checks that a value lies in a range, ends included. `unit` says what it counts, and may go on after a semicolon with how
/// to find the right value.
pub(super) fn within<T: PartialOrd + std::fmt::Display>(
    field: impl Into<String>,
    value: T,
    (low, high): (T, T),
    unit: &str,
) -> Result<(), SpecError> {
    if value >= low && value <= high {
        return Ok(());
    }
    let what = format!("{value} lies outside {low}..={high} {unit}");
    Err(SpecError::new(field, what.trim_end()))
}

/// A whole job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "JobText")]
pub struct JobSpec {
    /// Name, for people.
    pub name: String,
    /// Jobs of a higher priority get workers first (default 0).
    pub priority: i32,
    /// When a task, or the job, is given up.
    pub limits: Limits,
    /// Sets it apart from a job that is otherwise the same; empty but for those that run again what is done.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub nonce: String,
    /// Whose it is besides its submitter's: maintainers of the project may change it; empty = nobody's.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub project: String,
    /// What is done, in an order in which each stage comes after those that it needs.
    #[serde(rename = "stage")]
    pub stages: Vec<StageSpec>,
}

/// One step of a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "serde_json::Value")]
pub struct StageSpec {
    /// Its name in the job.
    pub name: String,
    /// Stages that must be done before this one begins.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<String>,
    /// It begins although tasks of the stages that it needs were given up.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub tolerate_dead: bool,
    /// Its tasks run although their results exist. Equal tasks give equal bytes: this proves it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub force: bool,
    /// What a worker must have.
    #[serde(skip_serializing_if = "Resources::is_none")]
    pub resources: Resources,
    /// What its tasks do.
    #[serde(flatten)]
    pub task: TaskSpec,
}

/// What a worker must have to run a stage's tasks. A worker runs one task at a time with all that it has.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Resources {
    /// CPU cores.
    pub cores: u32,
    /// Memory in GiB (2^30 bytes).
    pub memory_gib: f64,
    /// Graphics processors.
    pub gpus: u32,
    /// Labels, each of which the worker must have been given.
    pub labels: Vec<String>,
}

impl Resources {
    /// Whether nothing is asked for.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    fn check(&self) -> Result<(), SpecError> {
        within(
            "resources.cores",
            self.cores,
            (0, 65_536),
            "cores of one worker",
        )?;
        let gib = "GiB of one worker; 1 GiB is 1.07 GB";
        within("resources.memory_gib", self.memory_gib, (0.0, 1e6), gib)?;
        within(
            "resources.gpus",
            self.gpus,
            (0, 1024),
            "graphics processors of one worker",
        )?;
        if self.labels.len() > bounds::LIST {
            let what = format!(
                "{} labels; at most {} are allowed",
                self.labels.len(),
                bounds::LIST
            );
            return Err(SpecError::new("resources.labels", what));
        }
        for label in &self.labels {
            check_label(label).map_err(|what| SpecError::new("resources.labels", what))?;
        }
        Ok(())
    }
}

/// Checks a label: it stands between commas and in messages.
///
/// # Errors
/// What is wrong with it.
pub fn check_label(label: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.=".contains(c);
    if label.is_empty() || label.len() > 64 || !label.chars().all(plain) {
        return Err(format!(
            "{label:?} must be up to 64 letters, digits, '-', '_', '.' and '='"
        ));
    }
    Ok(())
}

/// Checks the name of a project: it stands between commas and in messages.
///
/// # Errors
/// What is wrong with it.
pub fn check_project(name: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if name.is_empty() || name.len() > 64 || !name.chars().all(plain) {
        return Err(format!(
            "{name:?} is not the name of a project: expected up to 64 letters, digits, '-', '_' and '.'"
        ));
    }
    Ok(())
}

/// Where results go.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputSettings {
    /// The store: a path or URL that every worker can reach.
    pub store: String,
    /// Folder of the data set in the store.
    pub dataset: String,
    /// Codec profile.
    #[serde(default = "default_profile")]
    pub profile: String,
}

pub(super) fn default_profile() -> String {
    "sqrt-u16".into()
}

impl OutputSettings {
    pub(super) fn check(&self) -> Result<(), SpecError> {
        if self.store.is_empty() {
            return Err(SpecError::new(
                "output.store",
                "is empty; give a path or URL",
            ));
        }
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        let dataset = &self.dataset;
        if dataset.is_empty() || dataset.starts_with('.') || !dataset.chars().all(plain) {
            return Err(SpecError::new(
                "output.dataset",
                format!(
                    "{dataset:?} must be a plain folder name of letters, digits, '-', '_' and '.'"
                ),
            ));
        }
        let kept = match &**dataset {
            MODELS => Some("trained models"),
            REPORTS => Some("reports about models"),
            _ => None,
        };
        if let Some(kept) = kept {
            let what = format!("{dataset:?} is where a store keeps {kept}; choose another name");
            return Err(SpecError::new("output.dataset", what));
        }
        Ok(())
    }
}

/// A data set that is read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SourceSettings {
    /// The store: a path or URL that every worker can reach.
    pub store: String,
    /// Folder of the data set in the store.
    pub dataset: String,
}

impl SourceSettings {
    /// How keys know it: by its place.
    pub(super) fn shaping(&self) -> serde_json::Value {
        serde_json::json!([self.store, self.dataset])
    }
}

/// When a task, or the job, is given up. Interruptions are free and have no limit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Failures of the task itself before it is dead.
    pub max_failures: u32,
    /// Losses of the worker while it ran the task before it is dead.
    pub max_crashes: u32,
    /// Workers that may run the job at a time; 0 = as many as there are.
    #[serde(skip_serializing_if = "is_zero")]
    pub max_workers: u32,
    /// What is not done by then (RFC 3339, e.g. `2026-12-01T18:00:00Z`) is cancelled; empty = never.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub deadline: String,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u32) -> bool {
    *n == 0
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_failures: 3,
            max_crashes: 3,
            max_workers: 0,
            deadline: String::new(),
        }
    }
}

impl Limits {
    /// The deadline as Unix time, milliseconds.
    ///
    /// # Errors
    /// It is no time.
    pub fn deadline_ms(&self) -> Result<Option<i64>, SpecError> {
        if self.deadline.is_empty() {
            return Ok(None);
        }
        let time = humantime::parse_rfc3339(&self.deadline);
        let since = time.map(|t| t.duration_since(std::time::UNIX_EPOCH));
        match since {
            Ok(Ok(since)) => Ok(i64::try_from(since.as_millis()).ok()),
            _ => Err(SpecError::new(
                "limits.deadline",
                format!(
                    "{:?} is no time such as \"2026-12-01T18:00:00Z\"",
                    self.deadline
                ),
            )),
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        // More attempts than these are an endless loop.
        for (field, value) in [
            ("limits.max_failures", self.max_failures),
            ("limits.max_crashes", self.max_crashes),
        ] {
            let unit = "attempts of a task; 1 gives it up at the first";
            within(field, value, (1, 1_000_000), unit)?;
        }
        let unit = "workers at a time; 0 is as many as there are";
        within("limits.max_workers", self.max_workers, (0, 1_000_000), unit)?;
        self.deadline_ms().map(|_| ())
    }
}

impl JobSpec {
    /// A job of one stage that renders.
    pub fn render(name: impl Into<String>, task: RenderTask) -> Self {
        Self {
            name: name.into(),
            priority: 0,
            limits: Limits::default(),
            nonce: String::new(),
            project: String::new(),
            stages: vec![StageSpec::new(TaskSpec::Render(task))],
        }
    }

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
        // First: what follows repeats texts in its messages.
        bounds::texts(self)?;
        if self.name.trim().is_empty() {
            return Err(SpecError::new("name", "is empty; give the job a name"));
        }
        self.limits.check()?;
        if !self.project.is_empty() {
            check_project(&self.project).map_err(|what| SpecError::new("project", what))?;
        }
        if self.stages.is_empty() || self.stages.len() > MAX_STAGES {
            let what = format!(
                "a job has 1 to {MAX_STAGES} stages, this one {}",
                self.stages.len()
            );
            return Err(SpecError::new("stage", what));
        }
        for (i, stage) in self.stages.iter().enumerate() {
            let before = &self.stages[..i];
            let checked = stage
                .check()
                .and_then(|()| stage.check_among(before, &self.stages[i + 1..]));
            checked.map_err(|e| self.at(stage, e))?;
        }
        let total: u64 = self.stages.iter().map(StageSpec::tasks).sum();
        if total > MAX_TASKS {
            let what = format!("its stages have {total} tasks together, at most {MAX_TASKS}");
            return Err(SpecError::new("stage", what));
        }
        Ok(())
    }

    /// Checks all that a coordinator holds a submitted job to: fields within their limits, everything pinned that a client
    /// must pin, and places that mean the same to everyone. Called once on either side.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check_submitted(&self) -> Result<(), SpecError> {
        self.check()?;
        let mut stages = self.stages.iter();
        stages.try_for_each(|stage| stage.check_resolved().map_err(|e| self.at(stage, e)))?;
        self.check_places()
    }

    /// Checks where a submitted job reads and writes: absolute paths or URLs, none of which climbs. (Job files may name
    /// relative ones; submission resolves them.)
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check_places(&self) -> Result<(), SpecError> {
        let mut stages = self.stages.iter();
        stages.try_for_each(|stage| stage.check_places().map_err(|e| self.at(stage, e)))
    }

    /// The field's full name: of several stages it says which.
    pub fn at(&self, stage: &StageSpec, error: SpecError) -> SpecError {
        match self.stages.len() {
            1 => error,
            _ => SpecError::new(format!("stage.{}.{}", stage.name, error.field), error.what),
        }
    }

    /// The stage of this name and its position.
    pub fn stage(&self, name: &str) -> Option<(usize, &StageSpec)> {
        self.stages.iter().enumerate().find(|(_, s)| s.name == name)
    }
}

impl StageSpec {
    /// A stage named after its kind, which needs nothing.
    pub fn new(task: TaskSpec) -> Self {
        Self {
            name: task.kind().to_owned(),
            needs: Vec::new(),
            tolerate_dead: false,
            force: false,
            resources: Resources::default(),
            task,
        }
    }

    /// Number of its tasks.
    pub fn tasks(&self) -> u64 {
        self.task.tasks()
    }

    /// The same with as much of its lists as a lease of tasks `lo..hi` needs.
    pub fn only(&self, lo: u64, hi: u64) -> Self {
        Self {
            task: self.task.only(lo, hi).unwrap_or_else(|| self.task.clone()),
            name: self.name.clone(),
            needs: self.needs.clone(),
            resources: self.resources.clone(),
            ..*self
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        let plain = |c: char| !c.is_control() && !"{}\"'`".contains(c);
        if self.name.trim().is_empty() || self.name.len() > 128 || !self.name.chars().all(plain) {
            let what = format!("{:?} must be 1 to 128 plain characters", self.name);
            return Err(SpecError::new("name", what));
        }
        self.resources.check()?;
        self.task.check()
    }

    /// Checks that it fits the stages before it and after it.
    fn check_among(&self, before: &[Self], after: &[Self]) -> Result<(), SpecError> {
        if before.iter().any(|other| other.name == self.name) {
            let what = format!("{:?} is another stage's too", self.name);
            return Err(SpecError::new("name", what));
        }
        let mut seen = BTreeSet::new();
        for need in &self.needs {
            if !before.iter().any(|other| other.name == *need) {
                let what = match after.iter().any(|other| other.name == *need) {
                    true => format!("{need:?} comes after this stage; put it before"),
                    false => format!("there is no stage {need:?} before this one"),
                };
                return Err(SpecError::new("needs", what));
            }
            if !seen.insert(need) {
                return Err(SpecError::new("needs", format!("{need:?} is named twice")));
            }
        }
        if let Some(place) = self.task.writes()
            && let Some(other) = before.iter().find(|s| s.task.writes() == Some(place))
        {
            let what = format!(
                "{:?} in {} is where stage {:?} puts its scenes; give each stage its own",
                place.1, place.0, other.name
            );
            return Err(SpecError::new("output.dataset", what));
        }
        if let Some(source) = self.task.reads() {
            let place = Some((&source.store, &source.dataset));
            let predicts = |s: &&Self| s.task.makes().is_none() && s.task.writes() == place;
            if let Some(other) = before.iter().find(predicts) {
                let what = format!(
                    "{:?} is where stage {:?} puts what models predict of scenes, which is no data set; name the stage that \
                     makes the scenes",
                    source.dataset, other.name
                );
                return Err(SpecError::new("source.dataset", what));
            }
            let makes = |s: &&Self| s.task.makes() == place;
            if let Some(other) = after.iter().find(makes) {
                let what = format!("is made by stage {:?}; put that before", other.name);
                return Err(SpecError::new("source", what));
            }
            if let Some(other) = before.iter().find(makes)
                && !self.needs.contains(&other.name)
            {
                let what = format!("lacks {:?}, whose scenes it reads", other.name);
                return Err(SpecError::new("needs", what));
            }
        }
        self.check_models(before, after)
    }

    /// Checks that models are trained once, and before they are read.
    fn check_models(&self, before: &[Self], after: &[Self]) -> Result<(), SpecError> {
        if let Some(model) = self.task.trains()
            && let Some(other) = before.iter().find(|s| s.task.trains() == Some(model))
        {
            let what = format!(
                "{:?} is what stage {:?} trains; give each model its own name",
                model.1, other.name
            );
            return Err(SpecError::new("train.model", what));
        }
        if let Some(place) = self.task.reports()
            && let Some(other) = before.iter().find(|s| s.task.reports() == Some(place))
        {
            let what = format!(
                "{:?} is stage {:?}'s report; give each its own name",
                place.1, other.name
            );
            return Err(SpecError::new("report.name", what));
        }
        let Some(store) = self.task.shelf() else {
            return Ok(());
        };
        for (field, model) in self.task.models() {
            let trains = |s: &&Self| s.task.trains() == Some((store, model));
            if let Some(other) = after.iter().find(trains) {
                let what = format!(
                    "{model:?} is trained by stage {:?}; put that before",
                    other.name
                );
                return Err(SpecError::new(field, what));
            }
            if let Some(other) = before.iter().find(trains)
                && !self.needs.contains(&other.name)
            {
                let what = format!("lacks {:?}, which trains {model:?}", other.name);
                return Err(SpecError::new("needs", what));
            }
        }
        self.task.check_among(before)
    }

    /// As [`JobSpec::check_places`], of one stage.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check_places(&self) -> Result<(), SpecError> {
        if let Some(source) = self.task.reads() {
            place("source.store", &source.store)?;
        }
        let results = self.task.results();
        place(results.field, results.store)?;
        let mut inputs = self.task.inputs(None).into_iter();
        inputs.try_for_each(|(field, path)| place(&field, path))
    }

    /// Checks what a client must have filled in before it submits.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    pub fn check_resolved(&self) -> Result<(), SpecError> {
        if let (field, "") = self.task.versioned() {
            let what = format!(
                "is empty; the client must fill in the version of its code for stages of kind {:?} before it submits",
                self.task.kind()
            );
            return Err(SpecError::new(field, what));
        }
        self.task.check_resolved()?;
        match self.task.scenes() {
            Some(scenes) => scenes.check_resolved(),
            None => Ok(()),
        }
    }
}

pub(super) fn check_source(source: &SourceSettings) -> Result<(), SpecError> {
    if source.store.is_empty() {
        return Err(SpecError::new(
            "source.store",
            "is empty; give a path or URL, or name a stage of the job",
        ));
    }
    if source.dataset.is_empty() {
        return Err(SpecError::new(
            "source.dataset",
            "is empty; give the data set's folder",
        ));
    }
    Ok(())
}

pub(super) fn check_count(field: &str, count: u64) -> Result<(), SpecError> {
    within(field, count, (1, MAX_TASKS), "scenes")
}

/// A place that means the same to everyone: absolute, and without a way up.
pub(super) fn place(field: &str, text: &str) -> Result<(), SpecError> {
    let fail = |what: &str| Err(SpecError::new(field, format!("{text:?} {what}")));
    if text.contains('\0') {
        return fail("holds a zero byte");
    }
    // What a URL's percent signs stand for counts too.
    let plain = text
        .to_ascii_lowercase()
        .replace("%2e", ".")
        .replace("%2f", "/")
        .replace("%5c", "\\");
    if plain.split(['/', '\\']).any(|part| part == "..") {
        return fail("has a part `..`; name the place itself");
    }
    if !text.contains("://") && !text.starts_with('/') {
        return fail(
            "is relative, which means another place to each worker; give an absolute path or a URL",
        );
    }
    Ok(())
}
