//! Own training: runs a Python file and stores what it publishes as a model. One task.
//!
//! Only workers with a Python get the tasks. The submission reads the code and writes it into the
//! job, compressed, so that every worker runs exactly these bytes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Manifest, Results, TaskKind},
    names::{check_model, check_split},
};
use crate::spec::{
    bounds::TEXT_BYTES,
    destination::Destination,
    limits::check_count,
    memory::Known,
    places::{MODELS, SourceSettings, check_source},
    spec_error::{SpecError, within},
    trial::Trial,
};

/// Most bytes of the code of a stage.
pub const CODE_BYTES: usize = 1 << 20;
/// Most files of the code of a stage.
pub const CODE_FILES: usize = 256;
/// Most bytes of the compressed code in a job.
const PACKED_BYTES: usize = 512 << 10;
/// What precedes a hash of a requirement.
const HASH: &str = "--hash=sha256:";
/// Most parameters, and most requirements.
const LIST: usize = 256;

/// Runs a Python file: one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PythonTask {
    /// The data set that the code reads, if any. The model is stored in the same store.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<SourceSettings>,
    /// Number of scenes of the data set.
    #[serde(skip_serializing_if = "is_zero")]
    pub count: u64,
    /// Code, parameters and results.
    pub python: PythonSettings,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

/// Code, parameters and results of an own training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PythonSettings {
    /// The Python file, or a folder of them, relative to the job file. The submission reads it.
    pub file: String,
    /// The function that is called, as `main`, or as `module:function` in a folder. Without it, the
    /// file runs as a script.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub entry: String,
    /// The name under which the results are stored as a model: letters, digits, `-`, `_` and `.`.
    pub model: String,
    /// The store of the model, for a stage without `source`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub store: String,
    /// The split of the data set whose sides the code may open, as `run.dataset(split = "train")`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub split: String,
    /// Values for the code, by name: `run.parameters`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parameters: BTreeMap<String, Value>,
    /// Distributions that the code needs, each as `name==version`. ` --hash=sha256:…` may follow,
    /// then every distribution that is installed needs one. A worker with
    /// `--python-environments` installs them, for others their Python must have them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub requirements: Vec<String>,
    /// The metric by which models are compared. A sweep needs it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub objective: String,
    /// Whether a smaller or a greater value of the metric is better.
    #[serde(default, skip_serializing_if = "is_minimise")]
    pub goal: Goal,
    /// Number of epochs that the code reports, for its progress and a sweep's rungs; 0 means
    /// unknown.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub epochs: u64,
    /// Minutes between checkpoints. A worker's death loses at most this much, plus the time to
    /// write one. Does not affect the result.
    #[serde(default = "five")]
    pub checkpoint_minutes: f64,
    /// The code; filled in at submission.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub code: Vec<CodeFile>,
    /// Data that makes the training a trial of a sweep; written by `[stage.sweep]`, not by hand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trial: Option<Trial>,
    /// Version of the runner, part of every task key; filled in at submission if omitted.
    #[serde(default)]
    pub version: String,
}

/// A file of the code.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CodeFile {
    /// Path below the folder of the code, with `/`.
    pub path: String,
    /// SHA-256 of its bytes, in hexadecimal.
    pub sha256: String,
    /// Its bytes, compressed by zlib, in pieces of base64.
    pub packed: Vec<String>,
}

/// The better direction of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    /// Smaller values are better.
    #[default]
    Minimise,
    /// Greater values are better.
    Maximise,
}

impl Goal {
    /// Returns a value as a loss, which is smaller for better values.
    pub fn loss(self, value: f64) -> f64 {
        match self {
            Self::Minimise => value,
            Self::Maximise => -value,
        }
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_minimise(goal: &Goal) -> bool {
    *goal == Goal::Minimise
}

fn five() -> f64 {
    5.0
}

impl Declared for PythonTask {
    const NAME: &'static str = "python";
    const FIELDS: &'static [&'static str] = &["source", "count", "python"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.optional("source")?,
            count: fields.or_default("count")?,
            python: fields.required("python")?,
        })
    }
}

impl PythonTask {
    /// Returns the store of the model.
    pub fn store(&self) -> &String {
        match &self.source {
            Some(source) => &source.store,
            None => &self.python.store,
        }
    }
}

impl TaskKind for PythonTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("python.version", &self.python.version),
            source: self.source.as_ref(),
            split: (!self.python.split.is_empty()).then_some(&self.python.split),
            models_store: Some(self.store()),
            makes: Makes::Model {
                store: self.store(),
                name: &self.python.model,
                training: None,
            },
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        let source = self.source.as_mut();
        let own_store = source.is_none();
        IoMut {
            version: Some(&mut self.python.version),
            source: source.map(|source| (source, &mut self.count)),
            stores: match own_store {
                true => vec![("python.store", &mut self.python.store)],
                false => Vec::new(),
            },
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        match &self.source {
            Some(source) => {
                check_source(source)?;
                check_count("count", self.count)?;
                if !self.python.store.is_empty() {
                    let what =
                        "is for stages without source; the model goes into the source's store";
                    return Err(SpecError::new("python.store", what));
                }
            }
            None if self.python.store.is_empty() => {
                let what = "is missing; give a path or URL for the model, or a source";
                return Err(SpecError::new("python.store", what));
            }
            None => {}
        }
        self.python.check()
    }

    fn check_resolved(&self) -> Result<(), SpecError> {
        if self.python.code.is_empty() {
            let what = "is empty; the client must fill in the code before it submits";
            return Err(SpecError::new("python.code", what));
        }
        Ok(())
    }

    fn shaping(&self) -> Value {
        let mut description = json!({
            "stage": "python",
            "source": self.source.as_ref().map(SourceSettings::shaping),
            "store": self.python.store,
            "count": self.count,
            "model": self.python.model,
            "settings": self.python.shaping(),
        });
        if let Some(trial) = &self.python.trial {
            description["trial"] = json!(trial);
        }
        description
    }

    fn results(&self) -> Results<'_> {
        let (name, store) = (&*self.python.model, &**self.store());
        let folder = format!("{MODELS}/{name}");
        Results {
            field: match self.source {
                Some(_) => "source.store",
                None => "python.store",
            },
            store,
            folder: folder.clone(),
            destination: Destination::folder("python.model", store, folder),
            manifest: match &self.python.trial {
                Some(trial) => Manifest::Trial(trial),
                None => Manifest::Model { name },
            },
        }
    }

    /// Only the code determines it; `resources.memory_gib` states it.
    fn memory(&self, _known: &Known, _threads: u32) -> Option<f64> {
        None
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            resumes: true,
            ..Dispatch::default()
        }
    }
}

impl PythonSettings {
    /// Returns everything that affects the results except the model's name.
    pub fn shaping(&self) -> Value {
        let code: BTreeMap<&str, &str> = self
            .code
            .iter()
            .map(|file| (&*file.path, &*file.sha256))
            .collect();
        json!({
            "entry": self.entry,
            "code": code,
            "split": self.split,
            "parameters": self.parameters,
            "requirements": self.requirements,
            "objective": self.objective,
            "goal": self.goal,
            "epochs": self.epochs,
            "version": self.version,
        })
    }

    fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("python.{field}"), what));
        if self.file.is_empty() {
            return fail("file", "is empty; name a Python file or a folder".into());
        }
        check_model("python.model", &self.model)?;
        if !self.split.is_empty() {
            check_split("python.split", &self.split)?;
        }
        check_entry(&self.entry)?;
        let (parameters, requirements) = (self.parameters.len(), self.requirements.len());
        within(
            "python.parameters",
            parameters as u64,
            (0, LIST as u64),
            "parameters",
        )?;
        within(
            "python.requirements",
            requirements as u64,
            (0, LIST as u64),
            "requirements",
        )?;
        self.check_requirements()?;
        if !self.objective.is_empty() {
            check_model("python.objective", &self.objective)?;
        }
        within(
            "python.epochs",
            self.epochs,
            (0, 10_000_000),
            "epochs; 0 is unknown",
        )?;
        let unit = "minutes; 0 saves whenever the code offers a checkpoint";
        within(
            "python.checkpoint_minutes",
            self.checkpoint_minutes,
            (0.0, 10_000.0),
            unit,
        )?;
        self.check_code()?;
        match &self.trial {
            Some(trial) => self.check_trial(trial),
            None => Ok(()),
        }
    }

    fn check_requirements(&self) -> Result<(), SpecError> {
        let hashed = self.requirements.iter().any(|r| r.contains(HASH));
        for (i, requirement) in self.requirements.iter().enumerate() {
            let fail = |what: String| {
                let field = format!("python.requirements[{i}]");
                Err(SpecError::new(field, format!("{requirement:?} {what}")))
            };
            let mut parts = requirement.split(' ');
            if !parts.next().is_some_and(is_pinned) {
                return fail("is not pinned; write name==version".into());
            }
            let mut hashes = parts.map(|part| part.strip_prefix(HASH).unwrap_or_default());
            let hex = |hash: &str| hash.len() == 64 && hash.bytes().all(|b| b.is_ascii_hexdigit());
            if !hashes.all(hex) {
                return fail(format!(
                    "may only go on with {HASH} and 64 hexadecimal digits"
                ));
            }
            if hashed && !requirement.contains(HASH) {
                return fail(format!("has no {HASH}…, but others have; give each one"));
            }
        }
        Ok(())
    }

    fn check_code(&self) -> Result<(), SpecError> {
        let packed = self.code.iter().flat_map(|file| &file.packed);
        let bytes: usize = packed.map(String::len).sum();
        if self.code.len() > CODE_FILES || bytes > PACKED_BYTES {
            let what = format!(
                "has {} files of {bytes} bytes compressed; at most {CODE_FILES} files of {PACKED_BYTES} bytes are allowed",
                self.code.len()
            );
            return Err(SpecError::new("python.code", what));
        }
        for (i, file) in self.code.iter().enumerate() {
            let parts = |path: &str| path.split('/').all(|p| !matches!(p, "" | "." | ".."));
            if !parts(&file.path) || file.path.contains('\\') || file.path.len() > TEXT_BYTES / 4 {
                let what = format!("{:?} is no path below the code's folder", file.path);
                return Err(SpecError::new(format!("python.code[{i}].path"), what));
            }
            let hex = file.sha256.bytes().all(|b| b.is_ascii_hexdigit());
            if file.sha256.len() != 64 || !hex {
                let what = format!("{:?} is no SHA-256", file.sha256);
                return Err(SpecError::new(format!("python.code[{i}].sha256"), what));
            }
        }
        Ok(())
    }

    fn check_trial(&self, trial: &Trial) -> Result<(), SpecError> {
        trial.check("python.trial")?;
        if self.objective.is_empty() {
            let what = "is missing; name the metric by which a sweep compares its trials";
            return Err(SpecError::new("python.objective", what));
        }
        if trial.stop.is_some() && self.epochs == 0 {
            let what = "is missing; a sweep that stops trials needs the number of their epochs";
            return Err(SpecError::new("python.epochs", what));
        }
        Ok(())
    }
}

/// Checks a function's name, `module:function` or a file.
fn check_entry(entry: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_alphanumeric() || "_./-:".contains(c);
    let parts = entry.split(':').count();
    if entry.is_empty() || (parts <= 2 && !entry.contains("..") && entry.chars().all(plain)) {
        return Ok(());
    }
    let what = format!("{entry:?}: expected function, module:function, or a file of the folder");
    Err(SpecError::new("python.entry", what))
}

/// Returns whether a requirement names one version.
fn is_pinned(requirement: &str) -> bool {
    let plain = |text: &str, more: &str| {
        !text.is_empty()
            && text
                .chars()
                .all(|c| c.is_ascii_alphanumeric() || more.contains(c))
    };
    requirement
        .split_once("==")
        .is_some_and(|(name, version)| plain(name, "-_.[],") && plain(version, ".+!-_"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn task(more: Value) -> Result<PythonTask, SpecError> {
        let mut python = json!({"file": "train.py", "model": "mine", "store": "/s"});
        for (name, value) in more.as_object().unwrap() {
            python[name] = value.clone();
        }
        let mut fields = Fields::new(json!({"kind": "python", "python": python})).unwrap();
        PythonTask::read(&mut fields)
    }

    fn refused(more: Value) -> String {
        task(more)
            .and_then(|task| task.check())
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn a_stage_is_checked_and_its_errors_name_the_field() {
        let hashed = format!("numpy==2.0.1 --hash=sha256:{}", "0a".repeat(32));
        for requirements in [
            json!(["torch==2.9.0", "numpy==2.0.1+cpu"]),
            json!([
                hashed,
                format!("{hashed} --hash=sha256:{}", "1b".repeat(32))
            ]),
        ] {
            let pinned = task(json!({"requirements": requirements})).unwrap();
            pinned.check().unwrap();
        }
        for (more, what) in [
            (
                json!({"requirements": ["a==1", hashed]}),
                "python.requirements[0]: \"a==1\" has no --hash",
            ),
            (
                json!({"requirements": ["a==1 --hash=sha256:00"]}),
                "may only go on with --hash",
            ),
            (json!({"requirements": ["a==1 "]}), "may only go on"),
            (
                json!({"requirements": ["torch"]}),
                "python.requirements[0]: \"torch\" is not pinned",
            ),
            (json!({"requirements": ["torch>=2"]}), "is not pinned"),
            (
                json!({"requirements": ["a==1 --index-url x"]}),
                "may only go on with --hash",
            ),
            (json!({"store": ""}), "python.store: is missing"),
            (json!({"entry": "a:b:c"}), "python.entry"),
            (json!({"entry": "../x.py"}), "python.entry"),
            (
                json!({"checkpoint_minutes": -1.0}),
                "python.checkpoint_minutes",
            ),
            (
                json!({"code": [{"path": "../a.py", "sha256": "00", "packed": []}]}),
                "python.code[0].path",
            ),
            (
                json!({"code": [{"path": "a.py", "sha256": "00", "packed": []}]}),
                "python.code[0].sha256",
            ),
        ] {
            let refused = refused(more.clone());
            assert!(refused.contains(what), "{more}: {refused}");
        }
    }

    #[test]
    fn the_key_depends_on_the_code_and_the_parameters_but_not_on_checkpoints() {
        let hash =
            |digit: &str| json!([{"path": "train.py", "sha256": digit.repeat(64), "packed": []}]);
        let base = json!({"code": hash("0"), "parameters": {"lr": 0.1}});
        let shaping = |more: &[(&str, Value)]| {
            let mut all = base.clone();
            for (name, value) in more {
                all[*name] = value.clone();
            }
            task(all).unwrap().shaping()
        };
        let ours = shaping(&[]);
        assert_eq!(ours, shaping(&[("checkpoint_minutes", json!(1.0))]));
        assert_ne!(ours, shaping(&[("code", hash("1"))]));
        assert_ne!(ours, shaping(&[("parameters", json!({"lr": 0.2}))]));
        assert_ne!(ours, shaping(&[("requirements", json!(["torch==2.9.0"]))]));
    }
}
