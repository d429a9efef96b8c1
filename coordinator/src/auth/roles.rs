//! The roles of callers, and the role that each method requires.

use std::{fmt, str::FromStr};

use picofarm_proto::messages::Act;
use serde::{Deserialize, Serialize};

/// A right that a caller may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// View jobs, their history and the farm.
    View,
    /// Plan, submit, steer and view jobs.
    Submit,
    /// Take leases and report results.
    Work,
    /// All rights.
    Admin,
}

impl Role {
    /// All roles.
    pub const ALL: [Self; 4] = [Self::View, Self::Submit, Self::Work, Self::Admin];

    /// Returns the name of the role in the token file.
    pub fn name(self) -> &'static str {
        match self {
            Self::View => "view",
            Self::Submit => "submit",
            Self::Work => "work",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|role| role.name() == text);
        found.ok_or_else(|| format!("{text:?} is no role; there are view, submit, work and admin"))
    }
}

/// The distinct roles of one caller, ascending.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(from = "Vec<Role>")]
pub struct Roles(Vec<Role>);

impl From<Vec<Role>> for Roles {
    fn from(mut roles: Vec<Role>) -> Self {
        roles.sort_unstable();
        roles.dedup();
        Self(roles)
    }
}

impl Roles {
    /// Returns whether there are no roles.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Iterates over the roles.
    pub fn iter(&self) -> impl Iterator<Item = Role> + '_ {
        self.0.iter().copied()
    }

    /// Returns whether the roles satisfy `needed`: the role itself, one that implies it, or any
    /// role.
    pub fn allow(&self, needed: Needs) -> bool {
        let has = |role| self.0.contains(&role);
        has(Role::Admin)
            || match needed {
                Needs::Nothing => true,
                Needs::Role(Role::View) => has(Role::View) || has(Role::Submit),
                Needs::Role(role) => has(role),
            }
    }
}

impl fmt::Display for Roles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<_> = self.iter().map(Role::name).collect();
        f.write_str(&names.join(","))
    }
}

/// The requirement of a method on its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Needs {
    /// A known caller.
    Nothing,
    /// A role, or one that implies it.
    Role(Role),
}

/// Each method of the services with its requirement.
pub const METHODS: &[(&str, Needs)] = &[
    ("/picofarm.v1.Farm/Session", Needs::Role(Role::Work)),
    ("/picofarm.v1.Jobs/GetServerInfo", Needs::Nothing),
    ("/picofarm.v1.Jobs/PlanJob", Needs::Role(Role::Submit)),
    ("/picofarm.v1.Jobs/SubmitJob", Needs::Role(Role::Submit)),
    ("/picofarm.v1.Jobs/CancelJob", Needs::Role(Role::Submit)),
    ("/picofarm.v1.Jobs/PauseJob", Needs::Role(Role::Submit)),
    ("/picofarm.v1.Jobs/ResumeJob", Needs::Role(Role::Submit)),
    ("/picofarm.v1.Jobs/RetryJob", Needs::Role(Role::Submit)),
    ("/picofarm.v1.Jobs/ListJobs", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/GetJob", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/GetJobSpec", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/WatchJob", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/ListEvents", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/ExplainJob", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/ListWorkers", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/GetDemand", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/DrainWorker", Needs::Role(Role::Admin)),
    ("/picofarm.v1.Jobs/ExamineWorkers", Needs::Role(Role::Admin)),
    ("/picofarm.v1.Jobs/GetUsage", Needs::Role(Role::View)),
    ("/picofarm.v1.Jobs/ListAudit", Needs::Role(Role::Admin)),
];

/// Returns the act that a method records in the audit log; `None` for methods that only read.
pub(crate) fn act(path: &str) -> Option<Act> {
    Some(match path.strip_prefix("/picofarm.v1.Jobs/")? {
        "SubmitJob" => Act::Submit,
        "CancelJob" => Act::Cancel,
        "PauseJob" => Act::Pause,
        "ResumeJob" => Act::Resume,
        "RetryJob" => Act::Retry,
        "DrainWorker" => Act::Drain,
        _ => return None,
    })
}

/// Returns the requirement of a path. Unlisted paths require an administrator, so an omission opens
/// nothing.
pub fn needs(path: &str) -> Needs {
    let listed = METHODS.iter().find(|(method, _)| *method == path);
    listed.map_or(Needs::Role(Role::Admin), |(_, needs)| *needs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_method_of_the_schema_is_listed_with_the_role_it_needs() {
        let here = std::env::var("CARGO_MANIFEST_DIR").unwrap();
        let mut found = Vec::new();
        let mut folders = vec![std::path::Path::new(&here).join("../proto")];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else if path.extension().is_some_and(|e| e == "proto") {
                    methods(&std::fs::read_to_string(path).unwrap(), &mut found);
                }
            }
        }
        let mut listed: Vec<_> = METHODS.iter().map(|(m, _)| (*m).to_owned()).collect();
        listed.sort();
        found.sort();
        assert_eq!(listed, found);
    }

    #[test]
    fn every_act_of_a_caller_is_a_listed_method() {
        let of_methods: Vec<_> = METHODS.iter().filter_map(|(m, _)| act(m)).collect();
        let of_callers = Act::ALL
            .into_iter()
            .filter(|a| !matches!(a, Act::Tokens | Act::Certificates));
        assert_eq!(of_methods.len(), of_callers.clone().count());
        for one in of_callers {
            assert!(of_methods.contains(&one), "{one:?}");
        }
    }

    fn methods(schema: &str, found: &mut Vec<String>) {
        let (mut package, mut service) = ("", "");
        for line in schema.lines().map(str::trim) {
            let name = |rest: &'static str| line.strip_prefix(rest).map(word);
            if let Some(name) = name("package ") {
                package = name;
            } else if let Some(name) = name("service ") {
                service = name;
            } else if let Some(name) = name("rpc ") {
                found.push(format!("/{package}.{service}/{name}"));
            }
        }
    }

    fn word(text: &str) -> &str {
        let end = text.find(|c: char| !(c.is_alphanumeric() || c == '.' || c == '_'));
        &text[..end.unwrap_or(text.len())]
    }

    #[test]
    fn roles_imply_what_they_should_and_nothing_more() {
        let may = |roles: &[Role], role| Roles::from(roles.to_vec()).allow(Needs::Role(role));
        for role in Role::ALL {
            assert!(may(&[role], role));
            assert!(may(&[Role::Admin], role));
            assert!(!may(&[], role));
            assert!(Roles::from(vec![role]).allow(Needs::Nothing));
        }
        assert!(may(&[Role::Submit], Role::View));
        for (has, wants) in [
            (Role::View, Role::Submit),
            (Role::Submit, Role::Work),
            (Role::Work, Role::View),
            (Role::Work, Role::Submit),
            (Role::Submit, Role::Admin),
        ] {
            assert!(!may(&[has], wants), "{has} must not do for {wants}");
        }
        assert_eq!(
            needs("/picofarm.v1.Jobs/DropEverything"),
            Needs::Role(Role::Admin)
        );
    }
}
