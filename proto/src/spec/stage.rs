//! One stage of a job, and its checks: alone, and together with earlier and later stages.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{
    kinds::{Fields, TaskKind, TaskSpec},
    limits::Resources,
    places::place,
    spec_error::SpecError,
};

/// One step of a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "serde_json::Value")]
pub struct StageSpec {
    /// Name of the stage in the job.
    pub name: String,
    /// Stages that must be done before this one begins.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<String>,
    /// Whether the stage begins although tasks of the stages that it needs were given up.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub tolerate_dead: bool,
    /// Whether tasks run although their results exist. This proves that equal tasks give equal
    /// bytes.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub force: bool,
    /// Resources that a worker must have.
    #[serde(skip_serializing_if = "Resources::is_none")]
    pub resources: Resources,
    /// Identities (UUIDs) of the stage's stores, by place. A worker with a different store at a
    /// place does not use it. Filled in by the submission if it can reach the stores; not a part of
    /// any key.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub stores: BTreeMap<String, String>,
    /// The work of the stage's tasks.
    #[serde(flatten)]
    pub task: TaskSpec,
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
            stores: fields.or_default("stores")?,
            task: TaskSpec::read(fields)?,
        })
    }
}

impl StageSpec {
    /// Creates a stage named after its kind, without needs.
    pub fn new(task: TaskSpec) -> Self {
        Self {
            name: task.kind().to_owned(),
            needs: Vec::new(),
            tolerate_dead: false,
            force: false,
            resources: Resources::default(),
            stores: BTreeMap::new(),
            task,
        }
    }

    /// Returns the number of tasks.
    pub fn tasks(&self) -> u64 {
        self.task.tasks()
    }

    /// Returns the stage with its lists reduced to those needed by a lease of tasks `lo..hi`.
    pub fn only(&self, lo: u64, hi: u64) -> Self {
        Self {
            task: self.task.only(lo, hi).unwrap_or_else(|| self.task.clone()),
            name: self.name.clone(),
            needs: self.needs.clone(),
            resources: self.resources.clone(),
            stores: self.stores.clone(),
            ..*self
        }
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        let plain = |c: char| !c.is_control() && !"{}\"'`".contains(c);
        if self.name.trim().is_empty() || self.name.len() > 128 || !self.name.chars().all(plain) {
            let what = format!("{:?} must be 1 to 128 plain characters", self.name);
            return Err(SpecError::new("name", what));
        }
        self.resources.check()?;
        self.check_identities()?;
        self.task.check()
    }

    /// Returns the places of the stage's stores without a final slash, for writing and reading.
    pub fn places(&self) -> BTreeSet<&str> {
        let read = self.task.reads().map(|source| &*source.store);
        let models = self.task.models_store().map(String::as_str);
        let all = [Some(self.task.results().store), read, models];
        let all = all.into_iter().flatten().map(|s| s.trim_end_matches('/'));
        all.filter(|place| !place.is_empty()).collect()
    }

    fn check_identities(&self) -> Result<(), SpecError> {
        let places = self.places();
        for (place, identity) in &self.stores {
            if !places.contains(&**place) {
                let what = format!("{place:?} is no store of this stage; leave it out");
                return Err(SpecError::new("stores", what));
            }
            if uuid::Uuid::try_parse(identity).is_err() {
                let what = format!(
                    "{identity:?} of {place:?} is no store's identity, which is a UUID; leave it out, and the submission \
                     fills it in"
                );
                return Err(SpecError::new("stores", what));
            }
        }
        Ok(())
    }

    /// Checks that the stage fits the stages before and after it.
    pub(super) fn check_among(&self, before: &[Self], after: &[Self]) -> Result<(), SpecError> {
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
        let Some(store) = self.task.models_store() else {
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
        let before: Vec<&dyn TaskKind> = before.iter().map(|s| &*s.task).collect();
        self.task.check_among(&before)
    }

    /// Checks the places that the stage reads and writes: absolute paths or URLs without `..`.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check_places(&self) -> Result<(), SpecError> {
        if let Some(source) = self.task.reads() {
            place("source.store", &source.store)?;
        }
        let results = self.task.results();
        place(results.field, results.store)?;
        let mut inputs = self.task.inputs(None).into_iter();
        inputs.try_for_each(|(field, path)| place(&field, path))
    }

    /// Checks the values that a client must have filled in before it submits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the field.
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
