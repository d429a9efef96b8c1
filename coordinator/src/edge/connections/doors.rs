//! Assigns the available places to connections. If none is free, the connection that has waited
//! longest for its first request is closed. Honest clients send it within moments, so silent
//! connections keep nobody out.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    net::IpAddr,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use tokio_util::sync::CancellationToken;

use crate::{memory::AddressGroup, observe::metrics::ConnectionCounts};

/// Delay of each further connection while all silent places are taken, and the interval of checks
/// meanwhile.
const CROWDED: Duration = Duration::from_millis(20);
const ASK_AGAIN: Duration = Duration::from_millis(2);

/// The places for connections.
pub(crate) struct Doors(Mutex<State>);

struct State {
    all: usize,
    per_address: usize,
    /// Most connections without a request.
    silent: usize,
    next: u64,
    open: BTreeMap<u64, (AddressGroup, CancellationToken)>,
    /// Time of the latest connection that had to replace one without a request.
    crowded: Option<Instant>,
    of: HashMap<AddressGroup, usize>,
    /// Connections that wait for their first request, oldest first: all of them, and those of each
    /// group.
    waiting: BTreeSet<u64>,
    waiting_of: HashMap<AddressGroup, BTreeSet<u64>>,
    counts: ConnectionCounts,
}

/// The reason why no place is free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Full {
    /// Every place has a connection with a request.
    All,
    /// Every place of this address has a connection with a request.
    Address,
}

impl Doors {
    /// Creates places: in total, for each address, and for connections without a request.
    pub(crate) fn new(all: usize, per_address: usize, silent: usize) -> Self {
        Self(Mutex::new(State {
            all,
            per_address,
            silent: silent.max(1),
            next: 0,
            open: BTreeMap::new(),
            crowded: None,
            of: HashMap::new(),
            waiting: BTreeSet::new(),
            waiting_of: HashMap::new(),
            counts: ConnectionCounts::default(),
        }))
    }

    /// Returns the counts of connections so far.
    pub(crate) fn counts(&self) -> ConnectionCounts {
        let state = self.lock();
        ConnectionCounts {
            open: state.open.len() as u64,
            ..state.counts
        }
    }

    /// Returns how long to wait before the next connection is accepted. If many connections have
    /// not sent a request, they get some time to do so before they are replaced.
    pub(crate) fn patience(&self) -> Duration {
        let mut state = self.lock();
        if state.waiting.len() < state.silent {
            state.crowded = None;
            return Duration::ZERO;
        }
        let since = state.crowded.get_or_insert_with(Instant::now).elapsed();
        if since < CROWDED {
            return ASK_AGAIN;
        }
        // The wait was for this connection. The next one waits again.
        state.crowded = None;
        Duration::ZERO
    }

    /// Returns the places in total, and for each address.
    pub(crate) fn bounds(&self) -> (usize, usize) {
        let state = self.lock();
        (state.all, state.per_address)
    }

    /// Takes a place until the value is dropped.
    ///
    /// # Errors
    /// Returns the reason if no place is free and none can be freed.
    pub(crate) fn enter(self: &Arc<Self>, address: IpAddr) -> Result<Held, Full> {
        let group = AddressGroup::from(address);
        let mut state = self.lock();
        if state.of.get(&group).copied().unwrap_or(0) >= state.per_address {
            let mine = state.waiting_of.get(&group);
            let oldest = mine.and_then(|ids| ids.first().copied());
            state.make_room(oldest, Full::Address)?;
        }
        if state.open.len() >= state.all || state.waiting.len() >= state.silent {
            let oldest = state.waiting.first().copied();
            state.make_room(oldest, Full::All)?;
        }
        let id = state.next;
        state.next += 1;
        let closed = CancellationToken::new();
        state.open.insert(id, (group, closed.clone()));
        *state.of.entry(group).or_default() += 1;
        state.waiting.insert(id);
        state.waiting_of.entry(group).or_default().insert(id);
        drop(state);
        let now = Instant::now();
        Ok(Held(Arc::new(Place {
            doors: Arc::clone(self),
            id,
            closed,
            use_: Mutex::new(Use {
                admitted: false,
                streams: 0,
                since: now,
            }),
        })))
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.lock().expect("no panic while locked")
    }
}

impl State {
    /// Closes the connection that has waited longest, if any.
    fn make_room(&mut self, oldest: Option<u64>, full: Full) -> Result<(), Full> {
        let Some(closed) = oldest.and_then(|id| self.leave(id)) else {
            self.counts.refused += 1;
            return Err(full);
        };
        self.counts.displaced += 1;
        closed.cancel();
        Ok(())
    }

    fn leave(&mut self, id: u64) -> Option<CancellationToken> {
        let (group, closed) = self.open.remove(&id)?;
        let count = self.of.get_mut(&group).expect("counted when it came");
        *count -= 1;
        if *count == 0 {
            self.of.remove(&group);
        }
        self.admit(id, group);
        Some(closed)
    }

    fn admit(&mut self, id: u64, group: AddressGroup) {
        self.waiting.remove(&id);
        if let Some(ids) = self.waiting_of.get_mut(&group) {
            ids.remove(&id);
            if ids.is_empty() {
                self.waiting_of.remove(&group);
            }
        }
    }
}

/// The place of a connection, freed when the value is dropped.
pub(crate) struct Held(Arc<Place>);

impl Held {
    pub(crate) fn place(&self) -> &Arc<Place> {
        &self.0
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.0.doors.lock().leave(self.0.id);
    }
}

/// The state of an open connection.
pub(crate) struct Place {
    doors: Arc<Doors>,
    id: u64,
    closed: CancellationToken,
    use_: Mutex<Use>,
}

struct Use {
    /// Whether a request was admitted.
    admitted: bool,
    streams: usize,
    /// The connection's beginning, or the end of its last stream.
    since: Instant,
}

impl Place {
    /// Returns the number of the connection, unique among these doors.
    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    /// Ends the connection.
    pub(crate) fn hang_up(&self) {
        self.closed.cancel();
    }

    /// Records an admitted request, which stays open until the value is dropped.
    pub(crate) fn stream(self: &Arc<Self>) -> Stream {
        let first = {
            let mut use_ = self.lock();
            use_.streams += 1;
            !std::mem::replace(&mut use_.admitted, true)
        };
        if first {
            let mut state = self.doors.lock();
            if let Some((group, _)) = state.open.get(&self.id) {
                let group = *group;
                state.admit(self.id, group);
            }
        }
        Stream(Arc::clone(self))
    }

    /// Waits until the connection must end, and returns the reason: its place went to another one,
    /// no request was admitted in time, or it was without streams for too long.
    pub(crate) async fn over(
        self: Arc<Self>,
        first_request: Duration,
        idle: Duration,
    ) -> &'static str {
        let late = async {
            loop {
                let (left, why) = self.left(first_request, idle);
                if left.is_zero() {
                    return why;
                }
                tokio::time::sleep(left).await;
            }
        };
        tokio::select! {
            why = late => why,
            () = self.closed.cancelled() => "others wait for its place and it has sent no request, or it takes no answer",
        }
    }

    /// Returns how long the connection may stay in its current state.
    fn left(&self, first_request: Duration, idle: Duration) -> (Duration, &'static str) {
        let use_ = self.lock();
        let gone = use_.since.elapsed();
        if !use_.admitted {
            return (
                first_request.saturating_sub(gone),
                "it has sent no request that is let in",
            );
        }
        let left = match use_.streams {
            0 => idle.saturating_sub(gone),
            _ => idle,
        };
        (left, "it was idle")
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Use> {
        self.use_.lock().expect("no panic while locked")
    }
}

/// An open request.
pub(crate) struct Stream(Arc<Place>);

impl Drop for Stream {
    fn drop(&mut self) {
        let mut use_ = self.0.lock();
        use_.streams -= 1;
        use_.since = Instant::now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn doors(all: usize, per_address: usize) -> Arc<Doors> {
        Arc::new(Doors::new(all, per_address, all))
    }

    fn ip(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    fn evicted(held: &Held) -> bool {
        held.place().closed.is_cancelled()
    }

    #[test]
    fn silent_connections_make_way_the_oldest_first_and_those_with_requests_stay() {
        let doors = doors(3, 3);
        let a = doors.enter(ip("10.0.0.1")).unwrap();
        let b = doors.enter(ip("10.0.0.2")).unwrap();
        let c = doors.enter(ip("10.0.0.3")).unwrap();
        let request = a.place().stream();
        let d = doors.enter(ip("10.0.0.4")).unwrap();
        assert_eq!([&a, &b, &c, &d].map(evicted), [false, true, false, false]);
        let (_c, _d) = (c.place().stream(), d.place().stream());
        assert_eq!(doors.enter(ip("10.0.0.5")).err(), Some(Full::All));
        let counts = doors.counts();
        assert_eq!((counts.open, counts.refused, counts.displaced), (3, 1, 1));
        // A connection that has had a request stays even without a current one.
        drop(request);
        assert_eq!(doors.enter(ip("10.0.0.5")).err(), Some(Full::All));
        drop(a);
        drop(b);
        let e = doors.enter(ip("10.0.0.5"));
        assert!(e.is_ok());
    }

    #[test]
    fn one_address_leaves_room_for_others_and_a_network_of_ipv6_is_one_address() {
        let doors = doors(10, 2);
        let mine: Vec<_> = ["2001:db8::1", "2001:db8::2"]
            .map(|a| doors.enter(ip(a)).unwrap())
            .into();
        let _streams: Vec<_> = mine.iter().map(|held| held.place().stream()).collect();
        assert_eq!(doors.enter(ip("2001:db8::3")).err(), Some(Full::Address));
        assert!(doors.enter(ip("2001:db8:0:1::3")).is_ok());
        let first = doors.enter(ip("10.0.0.1")).unwrap();
        let _second = doors.enter(ip("::ffff:10.0.0.1")).unwrap();
        let _third = doors.enter(ip("10.0.0.1")).unwrap();
        assert!(evicted(&first), "it is silent, and of the same address");
        assert!(!mine.iter().any(evicted));
    }

    #[test]
    fn few_may_be_without_a_request_and_they_have_time_to_send_it() {
        let doors = Arc::new(Doors::new(9, 9, 2));
        let first = doors.enter(ip("10.0.0.1")).unwrap();
        let second = doors.enter(ip("10.0.0.2")).unwrap();
        assert_eq!(doors.patience(), ASK_AGAIN);
        let _request = second.place().stream();
        assert_eq!(doors.patience(), Duration::ZERO);
        let third = doors.enter(ip("10.0.0.3")).unwrap();
        assert!(!evicted(&first) && !evicted(&third));
        let _fourth = doors.enter(ip("10.0.0.4")).unwrap();
        assert_eq!([&first, &second, &third].map(evicted), [true, false, false]);
    }

    #[test]
    fn places_are_counted_exactly() {
        let doors = doors(4, 4);
        for round in 0..100 {
            let held: Vec<_> = (0..6).map(|_| doors.enter(ip("10.0.0.1"))).collect();
            assert!(held.iter().all(Result::is_ok));
            let streams: Vec<_> = held
                .iter()
                .filter_map(|h| h.as_ref().ok())
                .map(|h| h.place().stream())
                .collect();
            if round % 2 == 0 {
                drop(streams);
                drop(held);
            } else {
                drop(held);
                drop(streams);
            }
            let state = doors.lock();
            assert!(state.open.is_empty() && state.of.is_empty());
            assert!(state.waiting.is_empty() && state.waiting_of.is_empty());
        }
    }

    #[tokio::test(start_paused = true)]
    async fn silence_ends_a_connection_and_a_stream_keeps_it() {
        let doors = doors(9, 9);
        let (first, idle) = (Duration::from_millis(50), Duration::from_millis(100));
        let silent = doors.enter(ip("10.0.0.1")).unwrap();
        let why = Arc::clone(silent.place()).over(Duration::ZERO, idle).await;
        assert!(why.contains("no request"), "{why}");
        let busy = doors.enter(ip("10.0.0.1")).unwrap();
        let stream = busy.place().stream();
        assert_eq!(busy.place().left(Duration::ZERO, idle).0, idle);
        drop(stream);
        let (left, why) = busy.place().left(first, Duration::ZERO);
        assert!(left.is_zero() && why.contains("idle"), "{why}");
    }
}
