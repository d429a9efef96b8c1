//! Memory that callers can make a coordinator use: counted before it is used, for each connection, for each caller and for
//! all together. What does not fit waits for a moment and is refused then; what can never fit is refused at once.
//!
//! Requests are charged by the length that they announce, specs again by what they cost once read, reading calls by what
//! they read, and answers by their length until they are taken.

mod charged;

use std::{
    collections::HashMap,
    fmt, io,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use picofarm_proto::model::JobSpec;
use tokio::sync::Notify;
use tonic::Status;

use crate::connections::{Doors, Group};

pub(crate) use charged::Charging;

const MIB: u64 = 1 << 20;
/// Memory of the process where nothing else is known.
const DEFAULT: u64 = 2048 * MIB;
/// What a worker's connection with its session takes.
const CONNECTION: u64 = 36 << 10;
/// The most that a connection takes on which no request was let in: half of a TLS handshake or of a request's headers, or a
/// hundred refusals that it does not take.
const SILENT: u64 = 128 << 10;
/// How long a charge waits for others to end.
const PATIENCE: Duration = Duration::from_secs(10);
/// A message in hand takes its length twice: as it came, and as it is decoded.
const TWICE: u64 = 2;
/// Bytes of memory for each byte of a spec while it is read, checked, hashed and recorded: the strings that it consists of,
/// its text, and copies of the text as it is hashed and bound to a statement.
const SPEC_BYTE: u64 = 4;
/// The same for each byte of a spec that is read from the catalog: the strings, and the text of one at a time.
const STORED_BYTE: u64 = 2;
/// Bytes of memory for each value of a spec: a string takes 24 by itself, and the least that the allocator gives.
const SPEC_VALUE: u64 = 48;

/// How much memory a coordinator may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryBounds {
    /// Bytes of the whole process: its control group's limit, or an option.
    pub process: u64,
}

impl Default for MemoryBounds {
    fn default() -> Self {
        Self { process: DEFAULT }
    }
}

impl MemoryBounds {
    /// Connections, jobs and requests together; the rest is the program's own, and what the allocator keeps.
    fn pool(self) -> u64 {
        self.process / 4 * 3
    }

    /// Requests and answers of one caller.
    fn caller(self) -> u64 {
        self.pool() / 2
    }

    /// Requests and answers on one connection.
    fn connection(self) -> u64 {
        self.pool() / 8 * 3
    }

    /// The most connections.
    pub(crate) fn connections(self) -> usize {
        usize::try_from(self.pool() / CONNECTION).unwrap_or(usize::MAX)
    }

    /// Connections that have not sent a request.
    pub(crate) fn silent(self) -> usize {
        usize::try_from(self.process / 8 / SILENT).unwrap_or(usize::MAX)
    }

    /// Specs of jobs that have not ended, which the coordinator keeps.
    fn jobs(self) -> u64 {
        self.process / 4
    }
}

/// Whose memory it is.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum Who {
    /// A caller known by its proof.
    Name(Arc<str>),
    /// Whoever calls from an address, where no proof is asked for.
    Address(Group),
}

/// The counts.
pub(crate) struct Memory {
    bounds: MemoryBounds,
    doors: Arc<Doors>,
    state: Mutex<State>,
    /// Something was given back.
    freed: Notify,
    /// Specs of jobs that have not ended.
    jobs: AtomicU64,
    refused: AtomicU64,
}

#[derive(Debug, Default)]
struct State {
    all: u64,
    /// The most that `all` ever was.
    most: u64,
    callers: HashMap<Who, u64>,
    connections: HashMap<u64, u64>,
}

/// Counts for the metrics.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Used {
    /// Bytes of requests and answers now.
    pub requests: u64,
    /// The most of them since the start.
    pub most: u64,
    /// The most that is allowed.
    pub allowed: u64,
    /// Bytes of the specs of jobs that have not ended.
    pub jobs: u64,
    /// Requests refused for lack of memory.
    pub refused: u64,
}

/// Which bound a charge does not fit.
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
    pub(crate) fn new(bounds: MemoryBounds, doors: Arc<Doors>) -> Self {
        Self {
            bounds,
            doors,
            state: Mutex::default(),
            freed: Notify::new(),
            jobs: AtomicU64::new(0),
            refused: AtomicU64::new(0),
        }
    }

    pub(crate) fn used(&self) -> Used {
        let state = self.lock();
        Used {
            requests: state.all,
            most: state.most,
            allowed: self.limit(Bound::All),
            jobs: self.jobs.load(Ordering::Relaxed),
            refused: self.refused.load(Ordering::Relaxed),
        }
    }

    /// Notes what the specs of jobs that have not ended take together.
    pub(crate) fn keep_jobs(&self, bytes: u64) {
        self.jobs.store(bytes, Ordering::Relaxed);
    }

    /// Checks that there is room for the spec of one more job.
    ///
    /// # Errors
    /// There is none: why, in words.
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
                let connections = self.doors.counts().open.saturating_mul(CONNECTION);
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

/// Whose requests are charged, and on which connection they came.
#[derive(Debug, Clone)]
pub(crate) struct Account {
    memory: Arc<Memory>,
    who: Who,
    connection: u64,
    /// The message of the request that this account came with.
    message: Option<Arc<Charge>>,
}

impl Account {
    pub(crate) fn new(memory: Arc<Memory>, who: Who, connection: u64) -> Self {
        Self {
            memory,
            who,
            connection,
            message: None,
        }
    }

    /// The same with what the request's message is charged with, which lives as long.
    fn holding(mut self, message: Charge) -> Self {
        self.message = Some(Arc::new(message));
        self
    }

    /// Takes what a spec costs beyond what its message was charged with.
    ///
    /// # Errors
    /// As [`Self::charge`].
    pub(crate) async fn charge_spec(&self, json: &str) -> Result<Charge, Status> {
        let paid = self.message.as_ref().map_or(0, |message| message.bytes);
        let cost = SPEC_BYTE * json.len() as u64 + SPEC_VALUE * values(json.as_bytes());
        self.charge("spec", cost.saturating_sub(paid)).await
    }

    /// Takes so much memory until the value is dropped; waits a moment where others have it.
    ///
    /// # Errors
    /// RESOURCE_EXHAUSTED with the bound and what to do.
    pub(crate) async fn charge(&self, what: &str, bytes: u64) -> Result<Charge, Status> {
        let until = tokio::time::Instant::now() + PATIENCE;
        loop {
            // Before the attempt, so that nothing that is given back after it is missed.
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

    /// Takes so much memory until the value is dropped, without waiting.
    ///
    /// # Errors
    /// RESOURCE_EXHAUSTED with the bound.
    fn charge_now(&self, what: &str, bytes: u64) -> Result<Charge, Status> {
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

    /// Counts memory that is taken already.
    fn count(&self, bytes: u64) -> Charge {
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

/// Memory that is taken, until the value is dropped.
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

/// What specs of this length together take while they are read from the catalog.
pub(crate) fn stored_cost(bytes: u64) -> u64 {
    bytes.saturating_mul(STORED_BYTE)
}

/// What a spec takes for as long as it is kept.
pub(crate) fn kept_cost(spec: &JobSpec) -> u64 {
    let mut size = Size::default();
    serde_json::to_writer(&mut size, spec).expect("a spec is plain data");
    size.bytes + SPEC_VALUE * size.values
}

/// The values in a part of a JSON text, at most.
fn values(text: &[u8]) -> u64 {
    let begins = text.iter().filter(|b| matches!(b, b',' | b'[' | b'{'));
    begins.count() as u64
}

/// Counts what is written and keeps nothing.
#[derive(Default)]
struct Size {
    bytes: u64,
    values: u64,
}

impl io::Write for Size {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        self.bytes += text.len() as u64;
        self.values += values(text);
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / MIB as f64)
}

#[cfg(test)]
mod tests {
    use std::net::IpAddr;

    use super::*;

    fn memory(mib: u64) -> Arc<Memory> {
        let process = mib * MIB;
        let doors = Arc::new(Doors::new(9, 9, 9));
        Arc::new(Memory::new(MemoryBounds { process }, doors))
    }

    fn account(memory: &Arc<Memory>, last: u8, connection: u64) -> Account {
        let address = IpAddr::from([10, 0, 0, last]);
        Account::new(Arc::clone(memory), Who::Address(address.into()), connection)
    }

    #[tokio::test(start_paused = true)]
    async fn each_bound_refuses_by_its_name_and_gives_back_what_was_taken() {
        // 192 MiB in all: 72 for a connection, 96 for a caller.
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
