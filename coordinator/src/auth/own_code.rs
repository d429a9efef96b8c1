//! Decides whose jobs may bring Python code of their own, which workers run as their own user.

use std::{collections::BTreeSet, str::FromStr};

use picofarm_proto::spec::{JobSpec, SpecError, TaskSpec, check_project};

/// The jobs that may bring code of their own.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum OwnCode {
    /// None.
    #[default]
    Nobody,
    /// All.
    Everyone,
    /// Those of these projects.
    Projects(BTreeSet<String>),
}

impl FromStr for OwnCode {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "all" {
            return Ok(Self::Everyone);
        }
        let projects: BTreeSet<String> = text.split(',').map(|p| p.trim().to_owned()).collect();
        for project in &projects {
            check_project(project).map_err(|what| format!("{what}; give all, or projects"))?;
        }
        Ok(Self::Projects(projects))
    }
}

impl OwnCode {
    /// Checks that the job may bring the code that it brings.
    ///
    /// # Errors
    /// Returns a [`SpecError`] with the remedy.
    pub(crate) fn check(&self, spec: &JobSpec) -> Result<(), SpecError> {
        let brings = |task: &TaskSpec| matches!(task, TaskSpec::Python(_));
        let Some(stage) = spec.stages.iter().find(|stage| brings(&stage.task)) else {
            return Ok(());
        };
        let refuse = |field: &str, what: String| Err(SpecError::new(field, what));
        match self {
            Self::Everyone => Ok(()),
            Self::Projects(allowed) if allowed.contains(&spec.project) => Ok(()),
            Self::Projects(allowed) => {
                let names: Vec<&str> = allowed.iter().map(String::as_str).collect();
                let what = format!(
                    "{:?} may not run code of its own here; submit the job in one of {}, which --allow-python of the \
                     coordinator names",
                    spec.project,
                    names.join(", ")
                );
                refuse("project", what)
            }
            Self::Nobody => {
                let what = format!(
                    "stage {:?} brings Python code, which this coordinator accepts from nobody; its administrator allows it by \
                     --allow-python all or --allow-python PROJECT, and workers run it with --python PATH",
                    stage.name
                );
                refuse("stage", what)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(project: &str, kind: &str) -> JobSpec {
        let stage = match kind {
            "python" => {
                r#"{"kind": "python", "python": {"file": "t.py", "model": "m", "store": "/s"}}"#
            }
            _ => {
                r#"{"scenes": {"kind": "primitive", "count": 1}, "output": {"store": "/s", "dataset": "d"}}"#
            }
        };
        let text = format!(r#"{{"name": "j", "project": "{project}", "stage": [{stage}]}}"#);
        serde_json::from_str(&text).unwrap()
    }

    #[test]
    fn code_is_accepted_from_nobody_from_projects_or_from_everyone() {
        let some: OwnCode = "lidar, tof".parse().unwrap();
        let all: OwnCode = "all".parse().unwrap();
        for allowed in [&OwnCode::Nobody, &some, &all] {
            allowed.check(&job("", "render")).unwrap();
        }
        all.check(&job("", "python")).unwrap();
        some.check(&job("tof", "python")).unwrap();
        let refused = some.check(&job("", "python")).unwrap_err().to_string();
        assert!(refused.contains("one of lidar, tof"), "{refused}");
        let refused = OwnCode::Nobody.check(&job("tof", "python")).unwrap_err();
        assert!(refused.to_string().contains("--allow-python"), "{refused}");
        assert!("".parse::<OwnCode>().is_err());
    }
}
