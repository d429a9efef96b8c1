//! Decides who may change and see which job. Pure.

use std::{fmt, str::FromStr};

use picofarm_catalog::{Owner, Sight};
use picofarm_proto::{
    ids::JobId,
    spec::{JobSpec, SpecError},
};

use super::{caller::Caller, roles::Role};

/// Which jobs of others callers see. Administrators see all jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Visibility {
    /// All jobs.
    #[default]
    All,
    /// The jobs of their projects. Other jobs do not exist for them.
    Project,
    /// None. Other jobs do not exist for them.
    Own,
}

impl Visibility {
    /// All values.
    pub const ALL: [Self; 3] = [Self::All, Self::Project, Self::Own];

    /// Returns the name of the value.
    pub fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::Project => "project",
            Self::Own => "own",
        }
    }

    /// Returns the circle of jobs among which an equal one is looked up; empty means all jobs. A
    /// job is shared only with callers who may see it.
    pub(crate) fn circle(self, caller: &Caller, spec: &JobSpec) -> String {
        match self {
            Self::All => String::new(),
            // The spec already contains the project, so the circle need not name it.
            Self::Project if !spec.project.is_empty() => "project".into(),
            Self::Project | Self::Own => format!("user {}", caller.name),
        }
    }
}

impl fmt::Display for Visibility {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Visibility {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|one| one.name() == text);
        found.ok_or_else(|| format!("{text:?} is none of all, project and own"))
    }
}

impl Caller {
    /// Returns whether the caller is an administrator.
    pub fn is_admin(&self) -> bool {
        self.roles.iter().any(|role| role == Role::Admin)
    }

    /// Returns whether the caller may cancel, pause, resume, retry or repeat a job of this owner.
    pub fn may_change(&self, owner: &Owner) -> bool {
        self.is_admin()
            || owner.user == *self.name
            || (!owner.project.is_empty() && self.maintains().contains(&owner.project))
    }

    /// Returns which jobs the caller may see.
    pub fn sight(&self, visibility: Visibility) -> Sight {
        let projects = match visibility {
            _ if self.is_admin() => return Sight::All,
            Visibility::All => return Sight::All,
            Visibility::Project => self.projects().map(str::to_owned).collect(),
            // A caller who may change a job must see it.
            Visibility::Own => self.maintains().to_vec(),
        };
        Sight::Of {
            user: self.name.to_string(),
            projects,
        }
    }

    /// Checks that the caller may submit a job with this project and priority.
    ///
    /// # Errors
    /// Returns a [`SpecError`] with the field, the bound and the remedy.
    pub(crate) fn may_submit(&self, spec: &JobSpec, max_priority: u32) -> Result<(), SpecError> {
        if self.is_admin() {
            return Ok(());
        }
        if spec.priority.unsigned_abs() > max_priority {
            return Err(SpecError::new(
                "priority",
                format!(
                    "{} lies outside -{max_priority}..={max_priority}, what --max-priority of the coordinator allows to callers \
                     who are no administrators; choose one within, or ask an administrator to submit the job",
                    spec.priority
                ),
            ));
        }
        let project = &spec.project;
        if project.is_empty() || self.projects().any(|mine| mine == project) {
            return Ok(());
        }
        let mine: Vec<_> = self.projects().collect();
        let mine = match &mine[..] {
            [] => "none".to_owned(),
            some => some.join(", "),
        };
        Err(SpecError::new(
            "project",
            format!(
                "{project:?} is none of the projects of {:?} ({mine}); choose one of these, leave it out, or ask an \
                 administrator (`picofarm token create --member {project}`)",
                self.name
            ),
        ))
    }

    /// Returns the projects with jobs that the caller may change.
    fn maintains(&self) -> &[String] {
        self.entry.as_ref().map_or(&[], |entry| &entry.maintainer)
    }

    /// Returns the projects in which the caller is a member or maintainer.
    fn projects(&self) -> impl Iterator<Item = &str> {
        let entry = self.entry.iter();
        entry
            .flat_map(|entry| entry.member.iter().chain(&entry.maintainer))
            .map(String::as_str)
    }
}

/// Returns the reason why a caller may not change a visible job.
pub(crate) fn not_owner(job: &JobId, owner: &Owner) -> String {
    let maintainers = match owner.project.as_str() {
        "" => String::new(),
        project => format!(", a maintainer of project {project:?}"),
    };
    format!(
        "job {job} is {:?}'s: only its owner{maintainers} or an administrator may change it",
        owner.user
    )
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::{
        super::{Entry, Roles},
        *,
    };

    fn caller(name: &str, role: Role, member: &[&str], maintainer: &[&str]) -> Caller {
        let texts = |list: &[&str]| list.iter().map(|s| (*s).to_owned()).collect();
        let roles = Roles::from(vec![role]);
        Caller {
            name: name.into(),
            roles: roles.clone(),
            until: None,
            authorities: 0,
            trust: None,
            entry: Some(Arc::new(Entry {
                name: name.into(),
                roles,
                sha256: None,
                certificate: Some("c".into()),
                expires: None,
                max_cores: None,
                max_bytes: None,
                member: texts(member),
                maintainer: texts(maintainer),
            })),
        }
    }

    fn owner(user: &str, project: &str) -> Owner {
        Owner {
            user: user.into(),
            project: project.into(),
        }
    }

    fn spec(extra: &str) -> JobSpec {
        let text = format!(
            r#"{{"name": "n", {extra} "scenes": {{"kind": "primitive", "count": 1}},
                "render": {{"renderer": "r"}}, "output": {{"store": "s", "dataset": "d"}}}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    #[test]
    fn only_owner_maintainer_and_administrator_may_change_a_job() {
        let of_lidar = owner("ada", "lidar");
        for (who, may) in [
            (caller("ada", Role::Submit, &[], &[]), true),
            (caller("bob", Role::Submit, &[], &[]), false),
            (caller("bob", Role::Submit, &["lidar"], &[]), false),
            (caller("bob", Role::Submit, &[], &["lidar"]), true),
            (caller("bob", Role::Submit, &[], &["tof"]), false),
            (caller("bob", Role::Admin, &[], &[]), true),
            (Caller::anyone(), true),
        ] {
            assert_eq!(who.may_change(&of_lidar), may, "{who:?}");
        }
        // A job without a project belongs to no project.
        assert!(!caller("bob", Role::Submit, &[], &[""]).may_change(&owner("ada", "")));
    }

    #[test]
    fn what_is_seen_follows_the_setting_and_whoever_may_change_a_job_sees_it() {
        let jobs = [owner("ada", ""), owner("ada", "lidar"), owner("bob", "tof")];
        let seen = |who: &Caller, visibility| {
            let sight = who.sight(visibility);
            jobs.each_ref().map(|job| sight.sees(job))
        };
        let member = caller("bob", Role::Submit, &["lidar"], &[]);
        assert_eq!(seen(&member, Visibility::All), [true; 3]);
        assert_eq!(seen(&member, Visibility::Project), [false, true, true]);
        assert_eq!(seen(&member, Visibility::Own), [false, false, true]);
        let maintainer = caller("eve", Role::View, &[], &["lidar"]);
        assert_eq!(seen(&maintainer, Visibility::Own), [false, true, false]);
        for visibility in Visibility::ALL {
            let admin = caller("root", Role::Admin, &[], &[]);
            assert_eq!(seen(&admin, visibility), [true; 3]);
            for who in [&member, &maintainer] {
                for (job, seen) in jobs.iter().zip(seen(who, visibility)) {
                    assert!(seen || !who.may_change(job));
                }
            }
            assert_eq!(visibility.name().parse(), Ok(visibility));
        }
    }

    #[test]
    fn an_equal_job_is_looked_for_only_among_those_that_the_caller_may_see() {
        let ada = caller("ada", Role::Submit, &["lidar"], &[]);
        let bob = caller("bob", Role::Submit, &["lidar"], &[]);
        let (alone, shared) = (spec(""), spec(r#""project": "lidar","#));
        let same = |visibility: Visibility, spec| {
            visibility.circle(&ada, spec) == visibility.circle(&bob, spec)
        };
        assert!(same(Visibility::All, &alone) && same(Visibility::All, &shared));
        assert!(!same(Visibility::Project, &alone) && same(Visibility::Project, &shared));
        assert!(!same(Visibility::Own, &alone) && !same(Visibility::Own, &shared));
    }

    #[test]
    fn priorities_and_projects_have_bounds() {
        let bob = caller("bob", Role::Submit, &["lidar"], &["tof"]);
        let says = |extra: &str, who: &Caller| {
            who.may_submit(&spec(extra), 100).map_err(|e| e.to_string())
        };
        for good in [
            "",
            r#""priority": 100,"#,
            r#""priority": -100,"#,
            r#""project": "tof","#,
        ] {
            assert_eq!(says(good, &bob), Ok(()), "{good}");
        }
        for bad in [101, -101, i32::MAX, i32::MIN] {
            let extra = format!(r#""priority": {bad},"#);
            let said = says(&extra, &bob).unwrap_err();
            let words = [
                "priority: ",
                "-100..=100",
                "--max-priority",
                "administrator",
            ];
            assert!(words.iter().all(|word| said.contains(word)), "{said}");
            assert_eq!(says(&extra, &Caller::anyone()), Ok(()));
        }
        let said = says(r#""project": "x","#, &bob).unwrap_err();
        let words = ["project: \"x\"", "(lidar, tof)", "leave it out"];
        assert!(words.iter().all(|word| said.contains(word)), "{said}");
    }
}
