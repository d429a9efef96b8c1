//! What the jobs of users consumed.

use std::ops::AddAssign;

use serde::Serialize;

/// The amounts that tasks consumed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Usage {
    /// Number of computed tasks.
    pub tasks: u64,
    /// Number of failed attempts, without interrupted ones.
    pub failures: u64,
    /// Milliseconds of tasks and failed attempts, times the cores that each used.
    pub core_ms: u64,
    /// Bytes that the tasks published.
    pub bytes: u64,
}

impl AddAssign for Usage {
    fn add_assign(&mut self, other: Self) {
        self.tasks = self.tasks.saturating_add(other.tasks);
        self.failures = self.failures.saturating_add(other.failures);
        self.core_ms = self.core_ms.saturating_add(other.core_ms);
        self.bytes = self.bytes.saturating_add(other.bytes);
    }
}

/// What usage is summed by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum UsageBy {
    /// The user who submitted the job.
    User,
    /// The job's `project`.
    Project,
    /// The day (UTC) on which the attempts ended.
    Day,
}

impl UsageBy {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::User, Self::Project, Self::Day];

    /// Returns the name.
    pub fn name(self) -> &'static str {
        match self {
            Self::User => "user",
            Self::Project => "project",
            Self::Day => "day",
        }
    }

    /// Returns the one with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|by| by.name() == name)
    }
}

/// The usage of one user, project or day.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct UsageRow {
    /// The user, the project (empty if jobs have none), or the number of the day since 1970-01-01.
    pub name: String,
    /// The amounts.
    pub usage: Usage,
}
