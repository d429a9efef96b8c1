//! Processes that train one network together over TCP: how they find one another, agree, and sum
//! gradients.
//!
//! # Finding one another
//! A training has *calls* in a place that all processes can reach ([`Rendezvous`], which is the
//! store in a farm): call 1, 2, 3, …, each created once and never changed, with the address of the
//! leading process since then. A new process connects to the process of the newest call. If that
//! does not answer, it creates the next call itself; if several try, one succeeds, and the others
//! connect to it. If a network partition results in two leading processes, this does no harm,
//! because both compute the same bits. The older one notices and joins the newer.
//!
//! # Agreeing
//! The leading process has a connection with each other one. Whenever one arrives or is lost, and
//! only between two steps, the leading one asks all for their state of progress, brings those
//! behind to the most advanced state (`Message::State`), and assigns a rank to each. A lost
//! process costs only the current step: no process takes a step before it has the gradients of all
//! batches. If the leading process is lost, the others make a new call.
//!
//! # Summing
//! Every two processes also have a connection with each other. Each process owns one part in N of
//! the gradients: it receives that part from all others, sums it in the fixed order
//! ([`picofarm_model::train::group::Blocks`]), and sends the sum to all. Each process sends and
//! receives 2 (N−1)/N of the gradients' bytes, which is the minimum of any exchange (Patarasuk and
//! Yuan, "Bandwidth optimal all-reduce algorithms", 2009).
//!
//! # Trust
//! Any process that can read the calls can join: they contain each process's secret, and a
//! connection without it is not read further. Connections are not encrypted: they require a trusted
//! network, like those of NCCL and Gloo.

#![forbid(unsafe_code)]

mod endpoint;
mod group;
mod link;
mod mesh;
mod message;

use serde::{Deserialize, Serialize};

pub use group::Members;

/// The place where processes of one training find one another.
pub trait Rendezvous {
    /// Returns the newest call and its number.
    ///
    /// # Errors
    /// A message, if the place cannot be reached.
    fn newest(&self) -> Result<Option<(u64, Call)>, String>;

    /// Creates a call with this number. Returns `false` if there already is one.
    ///
    /// # Errors
    /// Those of [`Self::newest`].
    fn make(&self, number: u64, call: &Call) -> Result<bool, String>;
}

/// The address of a leading process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Call {
    /// Address and port.
    pub address: String,
    /// The secret that it requires.
    pub secret: String,
    /// Name of the machine, for people.
    pub machine: String,
}
