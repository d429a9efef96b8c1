//! Limits the memory that callers can make a coordinator use. Memory is counted before it is used,
//! for each connection, for each caller and in total. A request that does not fit now waits a
//! moment and is then refused. A request that can never fit is refused at once.
//!
//! Requests are charged by their announced length, and specs again by their size in memory. Reading
//! calls are charged by the size of the data read, and answers by their length until they are
//! received.

mod accounts;
mod address;
mod bounds;
mod cost;

pub(crate) use accounts::{Account, Charge, Charged, Memory, MemoryUse};
pub(crate) use address::AddressGroup;
pub use bounds::MemoryBounds;
pub(crate) use cost::{TWICE, kept_cost, stored_cost};
