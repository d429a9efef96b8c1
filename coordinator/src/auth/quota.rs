//! Limits on the resources of a coordinator that callers can use, and on the log lines that they
//! can cause.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use picofarm_proto::ids::WorkerId;
use tonic::Status;

/// Quotas. A request beyond one is refused with RESOURCE_EXHAUSTED and the name of the limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quotas {
    /// Unfinished jobs of one caller.
    pub jobs_per_user: usize,
    /// Cores that the jobs of one caller use at a time; `None` for no bound.
    pub cores_per_user: Option<u32>,
    /// Bytes that the jobs of one caller publish, over all time; `None` for no bound.
    pub bytes_per_user: Option<u64>,
    /// Tasks of one job.
    pub tasks_per_job: u64,
    /// Concurrent worker sessions.
    pub sessions: usize,
    /// Priorities between the negative and positive of this value are open to everyone. Others are
    /// for administrators.
    pub max_priority: u32,
}

impl Default for Quotas {
    /// Returns 1,000 jobs a caller, any number of cores and bytes, 10,000,000 tasks a job, 10,000
    /// workers, and priorities from -100 to 100.
    fn default() -> Self {
        Self {
            jobs_per_user: 1_000,
            cores_per_user: None,
            bytes_per_user: None,
            tasks_per_job: 10_000_000,
            sessions: 10_000,
            max_priority: 100,
        }
    }
}

/// Allows one line a second, and counts the suppressed lines.
#[derive(Debug, Default)]
pub(crate) struct Throttle(Mutex<(Option<Instant>, u64)>);

impl Throttle {
    /// Returns how many lines were suppressed before this one, or `None` if this one is suppressed
    /// too.
    pub(crate) fn allows(&self) -> Option<u64> {
        let mut state = self.0.lock().expect("no panic while locked");
        let now = Instant::now();
        if state
            .0
            .is_some_and(|last| now - last < Duration::from_secs(1))
        {
            state.1 += 1;
            return None;
        }
        state.0 = Some(now);
        Some(std::mem::take(&mut state.1))
    }
}

/// The owners of worker ids. An id belongs to its caller while a session of it is open and for some
/// time after, so that no other caller can take over the leases of a worker that reconnects.
#[derive(Debug, Default)]
pub(crate) struct WorkerIds(Mutex<HashMap<WorkerId, Owned>>);

#[derive(Debug)]
struct Owned {
    caller: Arc<str>,
    sessions: u32,
    closed: Instant,
}

/// Time for which an id belongs to its caller after its last session.
const OWNED: Duration = Duration::from_secs(24 * 3600);
/// Most ids remembered. Beyond it, the ids closed longest ago are forgotten.
const IDS: usize = 65_536;

impl WorkerIds {
    /// Reserves `id` for a session of `caller`, until the value is dropped.
    ///
    /// # Errors
    /// Returns PERMISSION_DENIED if the id belongs to another caller.
    pub(crate) fn take(
        self: &Arc<Self>,
        id: WorkerId,
        caller: &Arc<str>,
    ) -> Result<ClaimedWorkerId, Status> {
        let mut ids = self.0.lock().expect("no panic while locked");
        let now = Instant::now();
        if let Some(owned) = ids.get(&id)
            && owned.caller != *caller
            && (owned.sessions > 0 || now - owned.closed < OWNED)
        {
            return Err(Status::permission_denied(format!(
                "worker id {id} belongs to another caller; {caller:?} must use an id of its own"
            )));
        }
        if ids.len() >= IDS && !ids.contains_key(&id) {
            ids.retain(|_, owned| owned.sessions > 0 || now - owned.closed < OWNED);
            let oldest = ids.iter().filter(|(_, owned)| owned.sessions == 0);
            let oldest = oldest
                .min_by_key(|(_, owned)| owned.closed)
                .map(|(id, _)| *id);
            if let Some(oldest) = oldest.filter(|_| ids.len() >= IDS) {
                ids.remove(&oldest);
            }
        }
        let owned = ids.entry(id).or_insert_with(|| Owned {
            caller: Arc::clone(caller),
            sessions: 0,
            closed: now,
        });
        owned.caller = Arc::clone(caller);
        owned.sessions += 1;
        Ok(ClaimedWorkerId {
            ids: Arc::clone(self),
            id,
        })
    }
}

/// A worker id in use.
#[derive(Debug)]
pub(crate) struct ClaimedWorkerId {
    ids: Arc<WorkerIds>,
    id: WorkerId,
}

impl Drop for ClaimedWorkerId {
    fn drop(&mut self) {
        let mut ids = self.ids.0.lock().expect("no panic while locked");
        if let Some(owned) = ids.get_mut(&self.id) {
            owned.sessions -= 1;
            owned.closed = Instant::now();
        }
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_worker_id_stays_its_callers_after_the_session() {
        let ids = Arc::new(WorkerIds::default());
        let (ada, eve): (Arc<str>, Arc<str>) = ("ada".into(), "eve".into());
        let id = WorkerId::from_uuid(Uuid::new_v4());
        let first = ids.take(id, &ada).unwrap();
        let second = ids.take(id, &ada).unwrap();
        assert!(ids.take(id, &eve).is_err());
        drop(first);
        drop(second);
        let refused = ids.take(id, &eve).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::PermissionDenied);
        assert!(ids.take(id, &ada).is_ok());
    }

    #[test]
    fn ids_that_come_and_go_do_not_pile_up() {
        let ids = Arc::new(WorkerIds::default());
        let ada: Arc<str> = "ada".into();
        let stays = WorkerId::from_uuid(Uuid::new_v4());
        let _held = ids.take(stays, &ada).unwrap();
        for _ in 0..IDS + 10 {
            drop(ids.take(WorkerId::from_uuid(Uuid::new_v4()), &ada).unwrap());
        }
        let held = ids.0.lock().unwrap();
        assert!(held.len() <= IDS && held.contains_key(&stays));
    }

    #[test]
    fn a_flood_of_refusals_is_one_line() {
        let throttle = Throttle::default();
        assert_eq!(throttle.allows(), Some(0));
        assert_eq!(throttle.allows(), None);
    }
}
