//! Places of connections. Anybody who reaches the server can open connections, so those that have
//! not sent the key are few, and a new one closes an old one of the caller that holds the most.
//! Connections that have sent the key have places of their own, which strangers cannot take.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv6Addr},
    sync::{Arc, Mutex, OnceLock},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;

/// Most connections that have not sent the key.
const STRANGERS: usize = 64;
/// Most connections that have sent the key. Each open page has one for its events.
pub const KNOWN: usize = 256;

/// The places of a server.
pub struct Places {
    strangers: Mutex<Strangers>,
    known: Arc<Semaphore>,
}

/// Connections without the key, the oldest first.
#[derive(Default)]
struct Strangers {
    next: u64,
    held: Vec<Stranger>,
}

struct Stranger {
    number: u64,
    peer: IpAddr,
    closed: CancellationToken,
}

/// The place of a connection; dropping it frees the place.
pub struct Place {
    places: Arc<Places>,
    number: u64,
    closed: CancellationToken,
    known: OnceLock<OwnedSemaphorePermit>,
}

impl Default for Places {
    fn default() -> Self {
        Self {
            strangers: Mutex::default(),
            known: Arc::new(Semaphore::new(KNOWN)),
        }
    }
}

impl Places {
    /// Returns a place for a new connection. If strangers hold all their places, the caller with
    /// the most of them loses its oldest connection.
    pub fn take(self: &Arc<Self>, peer: IpAddr) -> Place {
        let closed = CancellationToken::new();
        let mut strangers = self.strangers.lock().expect("no holder panics");
        if strangers.held.len() >= STRANGERS {
            strangers.close_one();
        }
        let number = strangers.next;
        strangers.next += 1;
        strangers.held.push(Stranger {
            number,
            peer: network(peer),
            closed: closed.clone(),
        });
        Place {
            places: Arc::clone(self),
            number,
            closed,
            known: OnceLock::new(),
        }
    }

    fn leave(&self, number: u64) {
        let mut strangers = self.strangers.lock().expect("no holder panics");
        strangers.held.retain(|held| held.number != number);
    }
}

impl Strangers {
    fn close_one(&mut self) {
        let mut counts: HashMap<IpAddr, usize> = HashMap::new();
        for held in &self.held {
            *counts.entry(held.peer).or_default() += 1;
        }
        let most = counts.values().copied().max().unwrap_or(0);
        let oldest = self.held.iter().position(|held| counts[&held.peer] == most);
        if let Some(oldest) = oldest {
            self.held.remove(oldest).closed.cancel();
        }
    }
}

impl Place {
    /// Returns a token that is cancelled when another connection needs this place.
    pub fn closed(&self) -> &CancellationToken {
        &self.closed
    }

    /// Moves the connection to the places of callers with the key. Returns `false` if these are all
    /// taken.
    pub fn knows_key(&self) -> bool {
        if self.known.get().is_some() {
            return true;
        }
        let Ok(permit) = Arc::clone(&self.places.known).try_acquire_owned() else {
            return false;
        };
        // Requests of one connection follow each other, so nobody else has set it.
        let _ = self.known.set(permit);
        self.places.leave(self.number);
        true
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.places.leave(self.number);
    }
}

/// Returns what stands for a caller: its address, or the first half of an IPv6 address, because a
/// machine has the whole second half to choose from.
fn network(peer: IpAddr) -> IpAddr {
    match peer.to_canonical() {
        IpAddr::V4(address) => IpAddr::V4(address),
        IpAddr::V6(address) => {
            let half = u128::from(address) >> 64 << 64;
            IpAddr::V6(Ipv6Addr::from(half))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    #[test]
    fn a_caller_with_many_connections_loses_its_oldest_and_others_keep_theirs() {
        let places = Arc::new(Places::default());
        let other = places.take(peer(1));
        let many: Vec<Place> = (0..STRANGERS + 9).map(|_| places.take(peer(2))).collect();
        assert!(!other.closed().is_cancelled());
        let closed = many.iter().map(|place| place.closed().is_cancelled());
        assert_eq!(closed.clone().filter(|closed| *closed).count(), 10);
        assert!(
            closed.take(10).all(|closed| closed),
            "the oldest are closed"
        );
    }

    #[test]
    fn connections_with_the_key_are_never_closed_for_others_and_are_limited() {
        let places = Arc::new(Places::default());
        let known: Vec<Place> = (0..KNOWN).map(|_| places.take(peer(1))).collect();
        // Those that were closed before they sent the key count too: a race that either may win.
        assert!(known.iter().all(Place::knows_key));
        let _strangers: Vec<Place> = (0..2 * STRANGERS).map(|_| places.take(peer(1))).collect();
        assert!(!known[KNOWN - 1].closed().is_cancelled());
        assert!(!places.take(peer(3)).knows_key());
        drop(known);
        assert!(places.take(peer(3)).knows_key());
    }

    #[test]
    fn addresses_of_one_network_are_one_caller() {
        let parse = |text: &str| network(text.parse().unwrap());
        assert_eq!(parse("2001:db8::1"), parse("2001:db8::ffff:1"));
        assert_ne!(parse("2001:db8::1"), parse("2001:db8:0:1::1"));
        assert_eq!(parse("::ffff:10.0.0.1"), parse("10.0.0.1"));
    }
}
