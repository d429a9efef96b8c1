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
pub(crate) struct ConnectionSlots(Mutex<State>);

struct State {
    all: usize,
    per_address: usize,
    /// Most connections without a request.
    silent: usize,
    next: u64,
    open: BTreeMap<u64, (AddressGroup, CancellationToken)>,
    /// Time of the latest connection that had to replace one without a request.
    crowded: Option<Instant>,
    open_by_group: HashMap<AddressGroup, usize>,
    /// Connections that wait for their first request, oldest first: all of them, and those of each
    /// group.
    waiting: BTreeSet<u64>,
    waiting_by_group: HashMap<AddressGroup, BTreeSet<u64>>,
    counts: ConnectionCounts,
}

/// The reason why no place is free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NoFreeSlot {
    /// Every place has a connection with a request.
    All,
    /// Every place of this address has a connection with a request.
    Address,
}

impl ConnectionSlots {
    /// Creates places: in total, for each address, and for connections without a request.
    pub(crate) fn new(all: usize, per_address: usize, silent: usize) -> Self {
        Self(Mutex::new(State {
            all,
            per_address,
            silent: silent.max(1),
            next: 0,
            open: BTreeMap::new(),
            crowded: None,
            open_by_group: HashMap::new(),
            waiting: BTreeSet::new(),
            waiting_by_group: HashMap::new(),
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
    pub(crate) fn enter(self: &Arc<Self>, address: IpAddr) -> Result<HeldSlot, NoFreeSlot> {
        let group = AddressGroup::from(address);
        let mut state = self.lock();
        if state.open_by_group.get(&group).copied().unwrap_or(0) >= state.per_address {
            let mine = state.waiting_by_group.get(&group);
            let oldest = mine.and_then(|ids| ids.first().copied());
            state.make_room(oldest, NoFreeSlot::Address)?;
        }
        if state.open.len() >= state.all || state.waiting.len() >= state.silent {
            let oldest = state.waiting.first().copied();
            state.make_room(oldest, NoFreeSlot::All)?;
        }
        let id = state.next;
        state.next += 1;
        let closed = CancellationToken::new();
        state.open.insert(id, (group, closed.clone()));
        *state.open_by_group.entry(group).or_default() += 1;
        state.waiting.insert(id);
        state.waiting_by_group.entry(group).or_default().insert(id);
        drop(state);
        let now = Instant::now();
        Ok(HeldSlot(Arc::new(ConnectionSlot {
            slots: Arc::clone(self),
            id,
            closed,
            activity: Mutex::new(Activity {
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
    fn make_room(&mut self, oldest: Option<u64>, full: NoFreeSlot) -> Result<(), NoFreeSlot> {
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
        let count = self
            .open_by_group
            .get_mut(&group)
            .expect("counted when it came");
        *count -= 1;
        if *count == 0 {
            self.open_by_group.remove(&group);
        }
        self.admit(id, group);
        Some(closed)
    }

    fn admit(&mut self, id: u64, group: AddressGroup) {
        self.waiting.remove(&id);
        if let Some(ids) = self.waiting_by_group.get_mut(&group) {
            ids.remove(&id);
            if ids.is_empty() {
                self.waiting_by_group.remove(&group);
            }
        }
    }
}

/// The place of a connection, freed when the value is dropped.
pub(crate) struct HeldSlot(Arc<ConnectionSlot>);

impl HeldSlot {
    pub(crate) fn slot(&self) -> &Arc<ConnectionSlot> {
        &self.0
    }
}

impl Drop for HeldSlot {
    fn drop(&mut self) {
        self.0.slots.lock().leave(self.0.id);
    }
}

/// The state of an open connection.
pub(crate) struct ConnectionSlot {
    slots: Arc<ConnectionSlots>,
    id: u64,
    closed: CancellationToken,
    activity: Mutex<Activity>,
}

struct Activity {
    /// Whether a request was admitted.
    admitted: bool,
    streams: usize,
    /// The connection's beginning, or the end of its last stream.
    since: Instant,
}

impl ConnectionSlot {
    /// Returns the number of the connection, unique among these slots.
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
            let mut activity = self.lock();
            activity.streams += 1;
            !std::mem::replace(&mut activity.admitted, true)
        };
        if first {
            let mut state = self.slots.lock();
            if let Some((group, _)) = state.open.get(&self.id) {
                let group = *group;
                state.admit(self.id, group);
            }
        }
        Stream(Arc::clone(self))
    }

    /// Waits until the connection must end, and returns the reason: its place went to another one,
    /// no request was admitted in time, or it was without streams for too long.
    pub(crate) async fn ended(
        self: Arc<Self>,
        first_request: Duration,
        idle: Duration,
    ) -> &'static str {
        let late = async {
            loop {
                let (left, why) = self.time_left(first_request, idle);
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
    fn time_left(&self, first_request: Duration, idle: Duration) -> (Duration, &'static str) {
        let activity = self.lock();
        let gone = activity.since.elapsed();
        if !activity.admitted {
            return (
                first_request.saturating_sub(gone),
                "it has sent no request that is let in",
            );
        }
        let left = match activity.streams {
            0 => idle.saturating_sub(gone),
            _ => idle,
        };
        (left, "it was idle")
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Activity> {
        self.activity.lock().expect("no panic while locked")
    }
}

/// An open request.
pub(crate) struct Stream(Arc<ConnectionSlot>);

impl Drop for Stream {
    fn drop(&mut self) {
        let mut activity = self.0.lock();
        activity.streams -= 1;
        activity.since = Instant::now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slots(all: usize, per_address: usize) -> Arc<ConnectionSlots> {
        Arc::new(ConnectionSlots::new(all, per_address, all))
    }

    fn ip(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    fn evicted(held: &HeldSlot) -> bool {
        held.slot().closed.is_cancelled()
    }

    #[test]
    fn silent_connections_make_way_the_oldest_first_and_those_with_requests_stay() {
        let slots = slots(3, 3);
        let a = slots.enter(ip("10.0.0.1")).unwrap();
        let b = slots.enter(ip("10.0.0.2")).unwrap();
        let c = slots.enter(ip("10.0.0.3")).unwrap();
        let request = a.slot().stream();
        let d = slots.enter(ip("10.0.0.4")).unwrap();
        assert_eq!([&a, &b, &c, &d].map(evicted), [false, true, false, false]);
        let (_c, _d) = (c.slot().stream(), d.slot().stream());
        assert_eq!(slots.enter(ip("10.0.0.5")).err(), Some(NoFreeSlot::All));
        let counts = slots.counts();
        assert_eq!((counts.open, counts.refused, counts.displaced), (3, 1, 1));
        // A connection that has had a request stays even without a current one.
        drop(request);
        assert_eq!(slots.enter(ip("10.0.0.5")).err(), Some(NoFreeSlot::All));
        drop(a);
        drop(b);
        let e = slots.enter(ip("10.0.0.5"));
        assert!(e.is_ok());
    }

    #[test]
    fn one_address_leaves_room_for_others_and_a_network_of_ipv6_is_one_address() {
        let slots = slots(10, 2);
        let mine: Vec<_> = ["2001:db8::1", "2001:db8::2"]
            .map(|a| slots.enter(ip(a)).unwrap())
            .into();
        let _streams: Vec<_> = mine.iter().map(|held| held.slot().stream()).collect();
        assert_eq!(
            slots.enter(ip("2001:db8::3")).err(),
            Some(NoFreeSlot::Address)
        );
        assert!(slots.enter(ip("2001:db8:0:1::3")).is_ok());
        let first = slots.enter(ip("10.0.0.1")).unwrap();
        let _second = slots.enter(ip("::ffff:10.0.0.1")).unwrap();
        let _third = slots.enter(ip("10.0.0.1")).unwrap();
        assert!(evicted(&first), "it is silent, and of the same address");
        assert!(!mine.iter().any(evicted));
    }

    #[test]
    fn few_may_be_without_a_request_and_they_have_time_to_send_it() {
        let slots = Arc::new(ConnectionSlots::new(9, 9, 2));
        let first = slots.enter(ip("10.0.0.1")).unwrap();
        let second = slots.enter(ip("10.0.0.2")).unwrap();
        assert_eq!(slots.patience(), ASK_AGAIN);
        let _request = second.slot().stream();
        assert_eq!(slots.patience(), Duration::ZERO);
        let third = slots.enter(ip("10.0.0.3")).unwrap();
        assert!(!evicted(&first) && !evicted(&third));
        let _fourth = slots.enter(ip("10.0.0.4")).unwrap();
        assert_eq!([&first, &second, &third].map(evicted), [true, false, false]);
    }

    #[test]
    fn places_are_counted_exactly() {
        let slots = slots(4, 4);
        for round in 0..100 {
            let held: Vec<_> = (0..6).map(|_| slots.enter(ip("10.0.0.1"))).collect();
            assert!(held.iter().all(Result::is_ok));
            let streams: Vec<_> = held
                .iter()
                .filter_map(|h| h.as_ref().ok())
                .map(|h| h.slot().stream())
                .collect();
            if round % 2 == 0 {
                drop(streams);
                drop(held);
            } else {
                drop(held);
                drop(streams);
            }
            let state = slots.lock();
            assert!(state.open.is_empty() && state.open_by_group.is_empty());
            assert!(state.waiting.is_empty() && state.waiting_by_group.is_empty());
        }
    }

    #[tokio::test(start_paused = true)]
    async fn silence_ends_a_connection_and_a_stream_keeps_it() {
        let slots = slots(9, 9);
        let (first, idle) = (Duration::from_millis(50), Duration::from_millis(100));
        let silent = slots.enter(ip("10.0.0.1")).unwrap();
        let why = Arc::clone(silent.slot()).ended(Duration::ZERO, idle).await;
        assert!(why.contains("no request"), "{why}");
        let busy = slots.enter(ip("10.0.0.1")).unwrap();
        let stream = busy.slot().stream();
        assert_eq!(busy.slot().time_left(Duration::ZERO, idle).0, idle);
        drop(stream);
        let (left, why) = busy.slot().time_left(first, Duration::ZERO);
        assert!(left.is_zero() && why.contains("idle"), "{why}");
    }
}
