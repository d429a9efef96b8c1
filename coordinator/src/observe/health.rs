//! Health of the actor and of its catalog, for `/healthz` and `/readyz`. Reading it does not
//! involve the actor.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use picofarm_catalog::Catalog;
use tokio_util::sync::CancellationToken;

/// The actor counts as stuck if its loop has not turned for this long.
const ALIVE: Duration = Duration::from_secs(30);
/// The catalog counts as unavailable if it has not answered for this long.
const READY: Duration = Duration::from_secs(10);

/// Interval between test writes to the catalog, which is also the time limit of each; the constant
/// below applies after a failure.
const TRY: Duration = Duration::from_secs(10);
const TRY_AGAIN: Duration = Duration::from_secs(1);
/// The catalog counts as full or stuck if no write has succeeded for this long.
const WRITTEN: Duration = Duration::from_secs(30);

/// Health of the actor and of its catalog.
pub(crate) struct Health {
    catalog: Mutex<State>,
    /// Unusable credential files, with the reason for each.
    access: Mutex<BTreeMap<&'static str, String>>,
    began: Instant,
    /// Last turn of the actor's loop, milliseconds after `began`.
    turned: AtomicU64,
}

impl Default for Health {
    fn default() -> Self {
        Self {
            catalog: Mutex::default(),
            access: Mutex::default(),
            began: Instant::now(),
            turned: AtomicU64::new(0),
        }
    }
}

#[derive(Default)]
struct State {
    beaten: Option<Instant>,
    /// Last success of a write that needs space.
    wrote: Option<Instant>,
    /// The reason if the last such write failed.
    full: Option<(&'static str, String)>,
    /// Brief reason for any client, and full reason for this machine.
    fault: Option<(&'static str, String)>,
}

/// The reason why no work is accepted, for any client and for users on this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Unready {
    pub what: String,
    /// May name files and hosts.
    pub detail: Option<String>,
}

impl fmt::Display for Unready {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl Health {
    /// Records a turn of the actor's loop.
    pub(crate) fn turn(&self) {
        let now = u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.turned.store(now, Ordering::Relaxed);
    }

    /// Returns the time since the last turn, or since the start.
    fn since_turn(&self) -> Duration {
        let turned = Duration::from_millis(self.turned.load(Ordering::Relaxed));
        self.began.elapsed().saturating_sub(turned)
    }

    /// Records an answer of the catalog.
    pub(crate) fn beat(&self) {
        let mut state = self.lock();
        state.beaten = Some(Instant::now());
        state.fault = None;
    }

    /// Records a successful write that needs space.
    pub(crate) fn wrote(&self) {
        let mut state = self.lock();
        state.wrote = Some(Instant::now());
        state.full = None;
    }

    /// Records a failed write that needs space.
    pub(crate) fn full(&self, brief: &'static str, why: &str) {
        self.lock().full = Some((brief, why.to_owned()));
    }

    /// Records why a life of the actor ended. Another one will be tried.
    pub(crate) fn fault(&self, brief: &'static str, why: &str) {
        self.lock().fault = Some((brief, why.to_owned()));
    }

    /// Records that a credential file is unusable (`Some`, with the reason), or usable again.
    pub(crate) fn access(&self, file: &'static str, why: Option<String>) {
        let mut access = self.access.lock().expect("no panic while locked");
        match why {
            Some(why) => access.insert(file, why),
            None => access.remove(file),
        };
    }

    /// Checks whether jobs and reports can be accepted.
    ///
    /// # Errors
    /// Returns the reason why not.
    pub(crate) fn ready(&self) -> Result<(), Unready> {
        let access = self.access.lock().expect("no panic while locked");
        if let Some((file, why)) = access.first_key_value() {
            return Err(Unready {
                what: format!(
                    "{file} cannot be used; every caller is refused until this is repaired"
                ),
                detail: Some(why.clone()),
            });
        }
        drop(access);
        let state = self.lock();
        if let Some((brief, why)) = state.fault.as_ref().or(state.full.as_ref()) {
            return Err(Unready {
                what: format!("{brief}; nothing is taken until it can be used again"),
                detail: Some(why.clone()),
            });
        }
        let what = match state.beaten.map(|at| at.elapsed()) {
            None => "the catalog has not answered yet".into(),
            Some(age) if age > READY => {
                format!("the catalog has not answered for {} s", age.as_secs())
            }
            Some(_) => match state.wrote.map(|at| at.elapsed()) {
                None => "the catalog has not been written yet".into(),
                Some(age) if age > WRITTEN => {
                    format!("the catalog has not been written for {} s", age.as_secs())
                }
                Some(_) => return Ok(()),
            },
        };
        Err(Unready { what, detail: None })
    }

    /// Checks whether the process works. A process that waits for its catalog does. Returns a
    /// description.
    ///
    /// # Errors
    /// Returns a description if the process does not work.
    pub(crate) fn alive(&self) -> Result<String, String> {
        let since = self.since_turn();
        if self.waits() {
            return Ok("ok, waiting for the catalog".into());
        }
        if since > ALIVE {
            let seconds = since.as_secs();
            return Err(format!(
                "the coordinator's loop has not turned for {seconds} s"
            ));
        }
        Ok(format!("ok, the loop turned {} ms ago", since.as_millis()))
    }

    /// Returns whether the actor is between two lives, so that its silence is the catalog's fault.
    fn waits(&self) -> bool {
        self.lock().fault.is_some()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.catalog.lock().expect("no panic while locked")
    }
}

/// Tests repeatedly, until `stop`, whether the catalog can be written. Runs separately from the
/// actor.
pub(crate) async fn try_writes(
    health: Arc<Health>,
    catalog: Arc<dyn Catalog>,
    stop: CancellationToken,
) {
    loop {
        let wait = match tokio::time::timeout(TRY, catalog.try_room()).await {
            Ok(Ok(())) => {
                health.wrote();
                TRY
            }
            Ok(Err(error)) => {
                health.full(error.brief(), &error.to_string());
                TRY_AGAIN
            }
            Err(_) => {
                let why = "a small write took over 10 s";
                health.full("the catalog takes no writes", why);
                TRY_AGAIN
            }
        };
        tokio::select! {
            () = tokio::time::sleep(wait) => {}
            () = stop.cancelled() => return,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readiness_follows_the_catalog() {
        let health = Health::default();
        assert!(
            health
                .ready()
                .unwrap_err()
                .to_string()
                .contains("not answered yet")
        );
        health.beat();
        let why = health.ready().unwrap_err().to_string();
        assert!(why.contains("not been written yet"), "{why}");
        health.wrote();
        assert_eq!(health.ready(), Ok(()));
        health.full("the disk is full", "no room in /var/lib/db");
        health.beat();
        let why = health.ready().unwrap_err();
        assert!(
            why.what.contains("disk is full"),
            "a beat takes no room: {why}"
        );
        health.wrote();
        assert_eq!(health.ready(), Ok(()));
        health.fault("the catalog failed", "no route to db.example");
        let why = health.ready().unwrap_err();
        assert!(
            !why.to_string().contains("db.example"),
            "hosts are for this machine alone"
        );
        assert_eq!(why.detail.as_deref(), Some("no route to db.example"));
        assert!(health.waits());
        health.beat();
        assert_eq!(health.ready(), Ok(()));
        let long_ago = Instant::now().checked_sub(2 * WRITTEN);
        health.lock().wrote = long_ago;
        assert_eq!(health.ready().is_err(), long_ago.is_some());
        health.wrote();
        let long_ago = Instant::now().checked_sub(2 * READY);
        health.lock().beaten = long_ago;
        assert_eq!(health.ready().is_err(), long_ago.is_some());
    }

    #[test]
    fn health_follows_the_loop_and_not_the_catalog() {
        let mut health = Health::default();
        let ok = |health: &Health| health.alive().is_ok();
        assert!(ok(&health), "it has just begun");
        health.began = Instant::now().checked_sub(2 * ALIVE).unwrap();
        let why = health.alive().unwrap_err();
        assert!(why.contains("not turned for 60 s"), "{why}");
        health.fault("the catalog failed", "no route to db.example");
        assert!(ok(&health), "it waits for the catalog");
        health.beat();
        assert!(!ok(&health));
        health.turn();
        assert!(ok(&health));
    }
}
