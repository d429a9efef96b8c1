//! Work too slow for the actor, which others do for it.

use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::Finished,
};

use crate::core::{Reported, SessionId};

/// Work too slow for the actor. Each result comes back as a command.
pub(crate) trait SlowWork: Send + Sync {
    /// Reads a job that the actor does not know yet and sends [`super::Command::Learn`].
    fn learn(&self, job: JobId);
    /// Checks against the store whether a report or the recorded result is right and sends
    /// [`super::Command::Judged`]. Returns `false`, and sends nothing, if no store can be checked.
    fn judge(&self, session: SessionId, report: &Finished, dispute: Dispute) -> bool;
    /// Replaces the recorded result by a report on which two workers agree and sends
    /// [`super::Command::Judged`].
    fn replace(&self, session: SessionId, report: &Finished, dispute: Dispute);
    /// Returns whether any store can be checked.
    fn can_check_stores(&self) -> bool;
    /// Checks reported results against their store and sends [`super::Command::Verified`].
    fn verify(&self, store: String, reports: Vec<Reported>);
}

/// A report with a manifest that differs from the recorded one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Dispute {
    pub stage: StageRef,
    pub recorded: [u8; 32],
}
