//! Ports of servers that are killed and come back where they were.
//!
//! A port that the system chooses is one of those that it also gives to clients: while its server is away, the next
//! connection of whatever runs beside may take it. Ports below that range are taken by nobody who does not ask for them.

use std::{
    net::TcpListener,
    sync::atomic::{AtomicU32, Ordering},
};

/// Below the range of ports that Linux gives to clients, above those of known services.
const PORTS: std::ops::Range<u32> = 21_000..32_000;

/// A port of loopback on which nobody listens, another one at each call.
///
/// # Panics
/// When all are taken.
pub fn lasting() -> u16 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let ports = PORTS.end - PORTS.start;
    // Tests that run at a time begin at different places.
    let first = std::process::id().wrapping_mul(7919) % ports;
    let tried = (0..ports).map(|_| {
        let step = NEXT.fetch_add(1, Ordering::Relaxed);
        (PORTS.start + (first + step) % ports) as u16
    });
    let mut free = tried.filter(|port| TcpListener::bind(("127.0.0.1", *port)).is_ok());
    free.next().expect("loopback has free ports")
}
