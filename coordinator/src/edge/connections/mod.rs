//! Connections: their number, the time for which they may be silent, and the start of TLS.

mod bounds;
mod incoming;
mod slots;
mod streams;
mod watched;

pub use bounds::Connections;
pub(crate) use bounds::raise_open_files;
pub(crate) use incoming::{Peer, accept};
pub(crate) use slots::{ConnectionSlot, ConnectionSlots};
pub(crate) use streams::Streams;
pub(crate) use watched::follow as follow_certificates;
