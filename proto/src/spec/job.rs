//! A job: a graph of stages, each with many tasks of one kind. The TOML job file has exactly these
//! fields. See [`JobSpec::check`] for their limits, and [`super::file`] for optional and short
//! forms.

use serde::{Deserialize, Serialize};

use std::collections::BTreeSet;

use crate::ids::JobId;

use super::{
    RenderTask, TaskSpec,
    bounds::{NAME_BYTES, cut},
    file::JobText,
    limits::{Limits, MAX_AFTER, MAX_STAGES, MAX_TASKS, check_project},
    refer,
    spec_error::SpecError,
    stage::StageSpec,
    texts,
};

/// A whole job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "JobText")]
pub struct JobSpec {
    /// Name for display.
    pub name: String,
    /// Jobs of a higher priority get workers first (default 0).
    pub priority: i32,
    /// Limits after which a task, or the job, is given up.
    pub limits: Limits,
    /// Distinguishes the job from an otherwise equal one. Empty except for jobs that repeat
    /// finished work.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub nonce: String,
    /// Project of the job; its maintainers may change the job. Empty means none.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub project: String,
    /// Jobs that must be done before any task of this job begins: in a job file their numbers,
    /// names or ids, after a submission their ids.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub after: Vec<String>,
    /// Stages, each after the stages that it needs.
    #[serde(rename = "stage")]
    pub stages: Vec<StageSpec>,
}

impl TryFrom<JobText> for JobSpec {
    type Error = SpecError;

    fn try_from(mut text: JobText) -> Result<Self, SpecError> {
        let mut spec = Self {
            stages: text.stages()?,
            name: text.name,
            priority: text.priority,
            limits: text.limits,
            nonce: text.nonce,
            project: text.project,
            after: text.after.into_iter().map(Into::into).collect(),
        };
        spec.resolve()?;
        Ok(spec)
    }
}

impl JobSpec {
    /// Creates a job with a single render stage.
    pub fn render(name: impl Into<String>, task: RenderTask) -> Self {
        Self {
            name: name.into(),
            priority: 0,
            limits: Limits::default(),
            nonce: String::new(),
            project: String::new(),
            after: Vec::new(),
            stages: vec![StageSpec::new(TaskSpec::Render(task))],
        }
    }

    /// Fills in values that follow from other stages: places, needs and numbers of scenes.
    ///
    /// # Errors
    /// Returns an error for a source that no earlier stage makes.
    pub fn resolve(&mut self) -> Result<(), SpecError> {
        refer::resolve(&mut self.stages)
    }

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        // This comes first, because the later checks repeat texts in their messages.
        self.check_texts()?;
        if self.name.trim().is_empty() {
            return Err(SpecError::new("name", "is empty; give the job a name"));
        }
        self.limits.check()?;
        if !self.project.is_empty() {
            check_project(&self.project).map_err(|what| SpecError::new("project", what))?;
        }
        if self.after.len() > MAX_AFTER {
            let what = format!("names {} jobs, at most {MAX_AFTER}", self.after.len());
            return Err(SpecError::new("after", what));
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

    /// Checks all requirements of a coordinator on a submitted job: fields within their limits,
    /// pinned versions and hashes, and places that mean the same on every machine. Client and
    /// coordinator each call it once.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check_submitted(&self) -> Result<(), SpecError> {
        self.check()?;
        let mut stages = self.stages.iter();
        stages.try_for_each(|stage| stage.check_resolved().map_err(|e| self.at(stage, e)))?;
        self.check_places()
    }

    /// Returns the ids of the jobs that must be done before this one begins, each once.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for a text that is not an id.
    pub fn after_jobs(&self) -> Result<Vec<JobId>, SpecError> {
        let ids = self.after.iter().map(|text| {
            text.parse().map_err(|_| {
                let what = format!("{text:?} is not the id of a job; a submission needs ids");
                SpecError::new("after", what)
            })
        });
        let ids: BTreeSet<JobId> = ids.collect::<Result<_, _>>()?;
        Ok(ids.into_iter().collect())
    }

    /// Checks the places of a submitted job: absolute paths or URLs without `..`. Job files may
    /// contain relative paths, which the submission resolves.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check_places(&self) -> Result<(), SpecError> {
        let mut stages = self.stages.iter();
        stages.try_for_each(|stage| stage.check_places().map_err(|e| self.at(stage, e)))
    }

    /// Returns the full name of a field, which includes the stage if there are several.
    pub fn at(&self, stage: &StageSpec, error: SpecError) -> SpecError {
        match self.stages.len() {
            1 => error,
            _ => SpecError::new(format!("stage.{}.{}", stage.name, error.field), error.what),
        }
    }

    /// Checks that every text is short enough and has no control characters.
    fn check_texts(&self) -> Result<(), SpecError> {
        let Err(fault) = texts::check(self) else {
            return Ok(());
        };
        let mut field = fault.path;
        let at = field.get(1).and_then(|at| at.parse::<usize>().ok());
        if field.first().is_some_and(|first| first == "stage")
            && let Some(stage) = at.and_then(|at| self.stages.get(at))
        {
            field.drain(..2);
            if self.stages.len() > 1 {
                field.insert(0, format!("stage.{}", cut(&stage.name, NAME_BYTES)));
            }
        }
        Err(SpecError::new(field.join("."), fault.what))
    }

    /// Returns the stage with this name and its position.
    pub fn stage(&self, name: &str) -> Option<(usize, &StageSpec)> {
        self.stages.iter().enumerate().find(|(_, s)| s.name == name)
    }
}
