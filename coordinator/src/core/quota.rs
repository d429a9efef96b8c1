//! The bounds on users: the cores that the jobs of one user use at a time, and the bytes that they
//! publish. The cores are those of the workers with leases of these jobs. A worker counts whole,
//! because its tasks use all its threads.

use std::collections::BTreeMap;

use picofarm_proto::{ids::WorkerId, show::size};

use super::{settings::UserQuotas, state::Core};

impl Core {
    /// Replaces the bounds. Leases beyond a lower bound stay.
    pub(crate) fn set_quotas(&mut self, quotas: UserQuotas) {
        self.quotas = quotas;
    }

    /// Replaces the bytes that the users' jobs have published.
    pub(crate) fn set_published(&mut self, published: BTreeMap<String, u64>) {
        self.published = published;
    }

    /// Adds bytes that a user's job has published since the sums were read.
    pub(super) fn add_published(&mut self, user: &str, bytes: u64) {
        if self.quotas.bytes.of(user).is_some() {
            let sum = self.published.entry(user.to_owned()).or_default();
            *sum = sum.saturating_add(bytes);
        }
    }

    /// Checks whether a user's jobs may publish more.
    ///
    /// # Errors
    /// Returns the bound, the bytes published, and the remedy.
    pub(super) fn may_publish(&self, user: &str) -> Result<(), String> {
        let used = self.published.get(user).copied().unwrap_or(0);
        match self.quotas.bytes.of(user) {
            Some(most) if used >= most => Err(over_bytes(user, used, most)),
            _ => Ok(()),
        }
    }

    /// Returns whether the cores of the user's jobs are bounded.
    pub(super) fn has_quota(&self, user: &str) -> bool {
        self.quotas.cores.of(user).is_some()
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
        let Some(most) = self.quotas.cores.of(user) else {
            return Ok(());
        };
        if self.load.works_for(user, worker) {
            return Ok(());
        }
        let used = self.load.cores_of_user(user);
        fits((used, more), self.load.cores_of(worker), (user, most))
    }

    /// Checks whether a new worker with so many cores could get a lease of a user's job now.
    ///
    /// # Errors
    /// Returns the bound and how much of it is used.
    pub(super) fn room_for(&self, user: &str, cores: u32) -> Result<(), String> {
        self.may_publish(user)?;
        let Some(most) = self.quotas.cores.of(user) else {
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

/// Describes a user's jobs that have published as many bytes as they may.
pub(crate) fn over_bytes(user: &str, used: u64, most: u64) -> String {
    format!(
        "jobs of {user:?} have published {} of at most {}; deleted results count too, so only a higher bound helps: max_bytes of \
         the caller in the token file, or --max-bytes-per-user at the coordinator",
        size(used),
        size(most)
    )
}
