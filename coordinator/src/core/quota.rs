//! The bound on the cores that the jobs of one user use at a time. These are the cores of the
//! workers with leases of these jobs. A worker counts whole, because its tasks use all its threads.

use picofarm_proto::ids::WorkerId;

use super::{settings::CoreQuotas, state::Core};

impl Core {
    /// Replaces the bounds. Leases beyond a lower bound stay.
    pub(crate) fn set_quotas(&mut self, quotas: CoreQuotas) {
        self.quotas = quotas;
    }

    /// Returns whether the user's jobs are bounded.
    pub(super) fn has_quota(&self, user: &str) -> bool {
        self.quotas.of(user).is_some()
    }

    /// Checks whether a worker may get a lease of a user's job, if the user's jobs are about to
    /// get `more` cores of others.
    ///
    /// # Errors
    /// Returns the bound and how much of it is used.
    pub(super) fn within_quota(
        &self,
        user: &str,
        worker: WorkerId,
        more: u64,
    ) -> Result<(), String> {
        let Some(most) = self.quotas.of(user) else {
            return Ok(());
        };
        if self.load.works_for(user, worker) {
            return Ok(());
        }
        let used = self.load.cores_of_user(user);
        fits((used, more), self.load.cores_of(worker), (user, most))
    }

    /// Checks whether a worker with so many cores could get a lease of a user's job now.
    ///
    /// # Errors
    /// Returns the bound and how much of it is used.
    pub(super) fn room_for(&self, user: &str, cores: u32) -> Result<(), String> {
        let Some(most) = self.quotas.of(user) else {
            return Ok(());
        };
        let used = self.load.cores_of_user(user);
        fits((used, 0), u64::from(cores.max(1)), (user, most))
    }
}

fn fits((used, more): (u64, u64), cores: u64, (user, most): (&str, u32)) -> Result<(), String> {
    if used + more + cores <= u64::from(most) {
        return Ok(());
    }
    let cores = match cores {
        1 => "1 core".to_owned(),
        cores => format!("{cores} cores"),
    };
    Err(format!(
        "jobs of {user:?} use {used} of at most {most} cores, and the worker has {cores}"
    ))
}
