//! Ports of servers that are killed and restarted at the same address.
//!
//! A port chosen by the system comes from the range for clients, so another connection can take it
//! while its server is down. Ports below that range are used only by programs that request them.

use std::{
    net::TcpListener,
    sync::atomic::{AtomicU32, Ordering},
};

/// Below the range of ports that Linux assigns to clients, and above those of known services.
const PORTS: std::ops::Range<u32> = 21_000..32_000;

/// Returns a loopback port on which nobody listens, a different one at each call.
///
/// # Panics
/// If all are in use.
pub fn lasting() -> u16 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let ports = PORTS.end - PORTS.start;
    // Concurrent tests start at different ports.
    let first = std::process::id().wrapping_mul(7919) % ports;
    let tried = (0..ports).map(|_| {
        let step = NEXT.fetch_add(1, Ordering::Relaxed);
        (PORTS.start + (first + step) % ports) as u16
    });
    let mut free = tried.filter(|port| TcpListener::bind(("127.0.0.1", *port)).is_ok());
    free.next().expect("loopback has free ports")
}
