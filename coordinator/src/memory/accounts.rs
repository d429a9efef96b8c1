//! Charges the memory of requests and jobs before it is used.

use std::{
    collections::HashMap,
    fmt,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use tokio::sync::Notify;
use tonic::Status;

use super::{
    address::AddressGroup,
    bounds::{CONNECTION, MemoryBounds, mib},
    cost::spec_cost,
};

/// Longest time that a charge waits for others to end.
const PATIENCE: Duration = Duration::from_secs(10);

/// The owner of charged memory.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum Charged {
    /// A caller identified by its credentials.
    Name(Arc<str>),
    /// Any caller from an address, if no credentials are required.
    Address(AddressGroup),
}

/// Returns the number of open connections.
type OpenConnections = Box<dyn Fn() -> u64 + Send + Sync>;

/// The memory counters.
pub(crate) struct Memory {
    bounds: MemoryBounds,
    open_connections: OpenConnections,
    state: Mutex<State>,
    /// Notified when memory is released.
    freed: Notify,
    /// Memory of the specs of unfinished jobs.
    jobs: AtomicU64,
    refused: AtomicU64,
}

#[derive(Debug, Default)]
struct State {
    all: u64,
    /// The highest value of `all` so far.
    most: u64,
    callers: HashMap<Charged, u64>,
    connections: HashMap<u64, u64>,
}

/// Counts for the metrics.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct MemoryUse {
    /// Bytes of current requests and answers.
    pub requests: u64,
    /// Highest value of `requests` since the start, bytes.
    pub most: u64,
    /// Limit of `requests`, bytes.
    pub allowed: u64,
    /// Bytes of the specs of unfinished jobs.
    pub jobs: u64,
    /// Requests refused for lack of memory.
    pub refused: u64,
}

/// The bound that a charge exceeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Bound {
    Connection,
    Caller,
    All,
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Connection => "the requests of one connection",
            Self::Caller => "the requests of one caller",
            Self::All => "the requests of all callers",
        })
    }
}

impl Memory {
    pub(crate) fn new(
        bounds: MemoryBounds,
        open_connections: impl Fn() -> u64 + Send + Sync + 'static,
    ) -> Self {
        Self {
            bounds,
            open_connections: Box::new(open_connections),
            state: Mutex::default(),
            freed: Notify::new(),
            jobs: AtomicU64::new(0),
            refused: AtomicU64::new(0),
        }
    }

    pub(crate) fn used(&self) -> MemoryUse {
        let state = self.lock();
        MemoryUse {
            requests: state.all,
            most: state.most,
            allowed: self.limit(Bound::All),
            jobs: self.jobs.load(Ordering::Relaxed),
            refused: self.refused.load(Ordering::Relaxed),
        }
    }

    /// Records the total memory of the specs of unfinished jobs.
    pub(crate) fn keep_jobs(&self, bytes: u64) {
        self.jobs.store(bytes, Ordering::Relaxed);
    }

    /// Checks that there is room for the spec of one more job.
    ///
    /// # Errors
    /// Returns the reason if there is no room.
    pub(crate) fn room_for_job(&self, bytes: u64) -> Result<(), String> {
        let (kept, most) = (self.jobs.load(Ordering::Relaxed), self.bounds.jobs());
        if kept.saturating_add(bytes) <= most {
            return Ok(());
        }
        self.refused.fetch_add(1, Ordering::Relaxed);
        Err(format!(
            "spec: the job takes {} of memory until it ends, and the jobs that have not ended take {} of the {} that they may; \
             wait for some to end, or give the coordinator more memory (--memory-mib)",
            mib(bytes),
            mib(kept),
            mib(most)
        ))
    }

    fn limit(&self, bound: Bound) -> u64 {
        match bound {
            Bound::Connection => self.bounds.connection(),
            Bound::Caller => self.bounds.caller(),
            Bound::All => {
                let pool = self.bounds.pool();
                let connections = (self.open_connections)().saturating_mul(CONNECTION);
                let others = self
                    .jobs
                    .load(Ordering::Relaxed)
                    .saturating_add(connections);
                pool.saturating_sub(others).max(pool / 8)
            }
        }
    }

    /// Adds a charge, if all bounds allow it.
    fn add(&self, account: &Account, bytes: u64) -> Result<(), Bound> {
        let mut state = self.lock();
        let caller = state.callers.get(&account.who).copied().unwrap_or(0);
        let connection = state.connections.get(&account.connection);
        let connection = connection.copied().unwrap_or(0);
        for (bound, used) in [
            (Bound::Connection, connection),
            (Bound::Caller, caller),
            (Bound::All, state.all),
        ] {
            if used.saturating_add(bytes) > self.limit(bound) {
                return Err(bound);
            }
        }
        state.add(account, bytes);
        Ok(())
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().expect("no panic while locked")
    }
}

impl State {
    fn add(&mut self, account: &Account, bytes: u64) {
        self.all += bytes;
        self.most = self.most.max(self.all);
        *self.callers.entry(account.who.clone()).or_default() += bytes;
        *self.connections.entry(account.connection).or_default() += bytes;
    }

    fn take(&mut self, account: &Account, bytes: u64) {
        self.all -= bytes;
        if let Some(used) = self.callers.get_mut(&account.who) {
            *used -= bytes;
            if *used == 0 {
                self.callers.remove(&account.who);
            }
        }
        if let Some(used) = self.connections.get_mut(&account.connection) {
            *used -= bytes;
            if *used == 0 {
                self.connections.remove(&account.connection);
            }
        }
    }
}

impl fmt::Debug for Memory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.used())
    }
}

/// The caller charged for requests, and the connection of the requests.
#[derive(Debug, Clone)]
pub(crate) struct Account {
    memory: Arc<Memory>,
    who: Charged,
    connection: u64,
    /// The charge for the message of this account's request.
    message: Option<Arc<Charge>>,
}

impl Account {
    pub(crate) fn new(memory: Arc<Memory>, who: Charged, connection: u64) -> Self {
        Self {
            memory,
            who,
            connection,
            message: None,
        }
    }

    /// Returns the account with the charge for its request's message, which lives as long as the
    /// account.
    pub(crate) fn holding(mut self, message: Charge) -> Self {
        self.message = Some(Arc::new(message));
        self
    }

    /// Charges the memory of a spec beyond the charge for its message.
    ///
    /// # Errors
    /// Returns the errors of [`Self::charge`].
    pub(crate) async fn charge_spec(&self, json: &str) -> Result<Charge, Status> {
        let paid = self.message.as_ref().map_or(0, |message| message.bytes);
        let cost = spec_cost(json);
        self.charge("spec", cost.saturating_sub(paid)).await
    }

    /// Charges this much memory until the value is dropped. Waits a moment if other requests use
    /// it.
    ///
    /// # Errors
    /// Returns RESOURCE_EXHAUSTED with the bound and a remedy.
    pub(crate) async fn charge(&self, what: &str, bytes: u64) -> Result<Charge, Status> {
        let until = tokio::time::Instant::now() + PATIENCE;
        loop {
            // This comes before the attempt, so that memory released after the attempt is not
            // missed.
            let freed = self.memory.freed.notified();
            let bound = match self.memory.add(self, bytes) {
                Ok(()) => {
                    return Ok(Charge {
                        account: self.clone(),
                        bytes,
                    });
                }
                Err(bound) => bound,
            };
            let least = self.memory.limit(Bound::Connection);
            if bytes > least {
                return Err(self.refuse(format!(
                    "{what} would take {} of memory, more than the {} that {} may take; make it smaller, or give the \
                     coordinator more memory (--memory-mib)",
                    mib(bytes),
                    mib(least),
                    Bound::Connection,
                )));
            }
            if tokio::time::timeout_at(until, freed).await.is_err() {
                return Err(self.refuse(format!(
                    "{what} would take {} of memory, and {bound} have taken all but less than that of the {} that they may; \
                     try again when they are answered",
                    mib(bytes),
                    mib(self.memory.limit(bound)),
                )));
            }
        }
    }

    /// Charges this much memory until the value is dropped, without waiting.
    ///
    /// # Errors
    /// Returns RESOURCE_EXHAUSTED with the bound.
    pub(crate) fn charge_now(&self, what: &str, bytes: u64) -> Result<Charge, Status> {
        match self.memory.add(self, bytes) {
            Ok(()) => Ok(Charge {
                account: self.clone(),
                bytes,
            }),
            Err(bound) => Err(self.refuse(format!(
                "{what} would take {} of memory, and {bound} may take {}; send less at a time",
                mib(bytes),
                mib(self.memory.limit(bound)),
            ))),
        }
    }

    /// Counts memory already in use, whatever the bounds.
    pub(crate) fn count(&self, bytes: u64) -> Charge {
        self.memory.lock().add(self, bytes);
        Charge {
            account: self.clone(),
            bytes,
        }
    }

    fn refuse(&self, why: String) -> Status {
        self.memory.refused.fetch_add(1, Ordering::Relaxed);
        Status::resource_exhausted(why)
    }
}

/// Charged memory, released when the value is dropped.
#[derive(Debug)]
pub(crate) struct Charge {
    account: Account,
    bytes: u64,
}

impl Drop for Charge {
    fn drop(&mut self) {
        let memory = &self.account.memory;
        memory.lock().take(&self.account, self.bytes);
        memory.freed.notify_waiters();
    }
}

#[cfg(test)]
mod tests {
    use std::net::IpAddr;

    use super::{super::bounds::MIB, *};

    fn memory(mib: u64) -> Arc<Memory> {
        let process = mib * MIB;
        Arc::new(Memory::new(MemoryBounds { process }, || 0))
    }

    fn account(memory: &Arc<Memory>, last: u8, connection: u64) -> Account {
        let address = IpAddr::from([10, 0, 0, last]);
        Account::new(
            Arc::clone(memory),
            Charged::Address(address.into()),
            connection,
        )
    }

    #[tokio::test(start_paused = true)]
    async fn each_bound_refuses_by_its_name_and_gives_back_what_was_taken() {
        // The pool is 192 MiB: at most 72 for a connection and 96 for a caller.
        let memory = memory(256);
        let ada = account(&memory, 1, 1);
        let first = ada.charge("a", 60 * MIB).await.unwrap();
        let why = ada.charge("spec", 73 * MIB).await.unwrap_err();
        assert_eq!(why.code(), tonic::Code::ResourceExhausted);
        assert!(why.message().contains("--memory-mib"), "{why}");
        let why = ada.charge("spec", 13 * MIB).await.unwrap_err();
        assert!(why.message().contains("one connection"), "{why}");
        let other = account(&memory, 1, 2);
        let why = other.charge("spec", 40 * MIB).await.unwrap_err();
        assert!(why.message().contains("one caller"), "{why}");
        let second = other.charge("spec", 30 * MIB).await.unwrap();
        let eve = account(&memory, 2, 3);
        let third = eve.charge("spec", 70 * MIB).await.unwrap();
        let bob = account(&memory, 3, 4);
        let why = bob.charge("spec", 50 * MIB).await.unwrap_err();
        assert!(why.message().contains("all callers"), "{why}");
        assert_eq!(memory.used().refused, 4);
        drop(first);
        let fourth = bob.charge("spec", 50 * MIB).await.unwrap();
        drop((second, third, fourth));
        let used = memory.used();
        assert_eq!((used.requests, used.most), (0, 160 * MIB));
        let state = memory.lock();
        assert!(state.callers.is_empty() && state.connections.is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn what_does_not_fit_waits_for_what_ends() {
        let memory = memory(256);
        let ada = account(&memory, 1, 1);
        let first = ada.charge("a", 60 * MIB).await.unwrap();
        let waiting = tokio::spawn(async move { ada.charge("b", 20 * MIB).await.map(drop) });
        tokio::time::sleep(Duration::from_secs(1)).await;
        assert!(!waiting.is_finished());
        drop(first);
        waiting.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn short_strings_cost_more_than_their_letters_and_a_message_is_paid_once() {
        let memory = memory(256);
        let ada = account(&memory, 1, 1);
        let short = format!("[{}]", vec!["\"a\""; 1000].join(","));
        let long = format!("[\"{}\"]", "a".repeat(short.len()));
        let cost = |json: String| {
            let ada = ada.clone();
            async move { ada.charge_spec(&json).await.unwrap().bytes }
        };
        let whole = cost(short.clone()).await;
        assert!(whole > 3 * cost(long).await);
        let message = ada.charge("a", 1_000).await.unwrap();
        let held = ada.clone().holding(message);
        assert_eq!(held.charge_spec(&short).await.unwrap().bytes, whole - 1_000);
    }

    #[test]
    fn jobs_that_have_not_ended_have_a_bound_of_their_own() {
        let memory = memory(256);
        assert_eq!(memory.used().allowed, 192 * MIB);
        memory.keep_jobs(60 * MIB);
        assert_eq!(memory.used().allowed, 132 * MIB);
        assert!(memory.room_for_job(4 * MIB).is_ok());
        let why = memory.room_for_job(5 * MIB).unwrap_err();
        assert!(why.contains("64.0 MiB"), "{why}");
    }
}
