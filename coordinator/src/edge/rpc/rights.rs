//! Checks who may see and change which job, and records it in the audit log.

use picofarm_catalog::Owner;
use picofarm_proto::{ids::JobId, messages::Act};
use tonic::Status;

use super::link::{Link, broken, no_such_job};
use crate::{
    actor::{Command, Reply},
    auth::{Caller, Needs, Role, not_owner},
};

impl Link {
    async fn owner(&self, job: JobId) -> Result<Owner, Status> {
        let found = self.catalog.owner(job).await;
        let found = found.map_err(broken)?;
        found.ok_or_else(|| no_such_job(job))
    }

    /// Checks that a caller may see a job.
    ///
    /// # Errors
    /// Returns NOT_FOUND with the same message as for a job that does not exist.
    pub(super) async fn may_see(&self, caller: &Caller, job: JobId) -> Result<(), Status> {
        let sight = caller.sight(self.visibility);
        if sight == picofarm_catalog::Sight::All {
            return Ok(());
        }
        match sight.sees(&self.owner(job).await?) {
            true => Ok(()),
            false => Err(no_such_job(job)),
        }
    }

    /// Checks that a caller may change a job.
    ///
    /// # Errors
    /// Returns PERMISSION_DENIED, or NOT_FOUND for a job that the caller may not see.
    async fn may_change(&self, caller: &Caller, job: JobId) -> Result<(), Status> {
        if caller.is_admin() {
            return Ok(());
        }
        let owner = self.owner(job).await?;
        if caller.may_change(&owner) {
            return Ok(());
        }
        if !caller.sight(self.visibility).sees(&owner) {
            return Err(no_such_job(job));
        }
        Err(Status::permission_denied(not_owner(&job, &owner)))
    }

    /// Returns whether a caller may change a job that it may see.
    ///
    /// # Errors
    /// Returns NOT_FOUND for a missing job, or UNAVAILABLE if the catalog fails.
    pub(super) async fn has_right(&self, caller: &Caller, job: JobId) -> Result<bool, Status> {
        if !caller.roles.allow(Needs::Role(Role::Submit)) {
            return Ok(false);
        }
        Ok(caller.is_admin() || caller.may_change(&self.owner(job).await?))
    }

    /// Sends a command about a job to the actor, if the caller may change the job, and records it.
    pub(super) async fn steer<T>(
        &self,
        caller: &Caller,
        act: Act,
        job: JobId,
        command: impl FnOnce(Reply<T>) -> Command,
    ) -> Result<T, Status> {
        let answer = match self.may_change(caller, job).await {
            Ok(()) => self.ask(command).await,
            Err(refused) => Err(refused),
        };
        self.audit
            .record(&caller.name, act, Some(job), &answer, "")
            .await;
        answer
    }
}
