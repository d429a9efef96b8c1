//! Typed identifiers, so that a job id cannot be passed for a range id.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use uuid::Uuid;

/// The error for a text without a valid id of the expected kind.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not a {kind} id; expected a UUID such as {}", Uuid::nil())]
pub struct IdError {
    kind: &'static str,
    text: String,
}

macro_rules! id {
    ($(#[$doc:meta])* $name:ident, $kind:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(Uuid);

        impl $name {
            /// Wraps a UUID generated elsewhere (ids are generated at the edge, never in pure
            /// code).
            pub const fn from_uuid(uuid: Uuid) -> Self {
                Self(uuid)
            }

            /// Returns the UUID.
            pub const fn uuid(self) -> Uuid {
                self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl FromStr for $name {
            type Err = IdError;
            fn from_str(text: &str) -> Result<Self, IdError> {
                Uuid::parse_str(text).map(Self).map_err(|_| IdError {
                    kind: $kind,
                    text: text.to_owned(),
                })
            }
        }
    };
}

id!(
    /// One submission.
    JobId,
    "job"
);
id!(
    /// A range of a stage: consecutive tasks leased together.
    RangeId,
    "range"
);
id!(
    /// A worker, across its restarts.
    WorkerId,
    "worker"
);
id!(
    /// One process of a worker, new at every start.
    Incarnation,
    "incarnation"
);
id!(
    /// One life of a coordinator on a catalog, new at every start and after every failed write.
    InstanceId,
    "instance"
);

/// A stage of a job. Its tasks have indices from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct StageRef {
    /// The job.
    pub job: JobId,
    /// Position among the job's stages.
    pub stage: u32,
}

impl fmt::Display for StageRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.job, self.stage)
    }
}

/// Fences a lease. It grows with each grant of a range, so that messages of a former holder no
/// longer count.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, Default,
)]
#[serde(transparent)]
pub struct Epoch(pub u64);

impl fmt::Display for Epoch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Refers to a lease on both sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LeaseRef {
    /// The range.
    pub range: RangeId,
    /// The epoch under which it was granted.
    pub epoch: Epoch,
}
