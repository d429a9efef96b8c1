//! Processes that train one network together over TCP: how they find one another, agree, and add up gradients.
//!
//! # Finding one another
//! A training has *calls* in a place that all processes reach ([`Rendezvous`], in a farm the store): call 1, 2, 3, …, each
//! made once and never changed, with the address of the process that leads since then. Whoever comes goes to the newest
//! call's process. Where that does not answer, it makes the next call itself; of several that try, one succeeds, and the
//! others go to it. Two processes that both lead, because a network was cut between them, do no harm: both come to the same
//! bits. The older one notices and joins the newer.
//!
//! # Agreeing
//! The process that leads and each other one keep a connection. Whenever one comes or is lost, and only between two
//! steps, the leading one asks all where they stand, brings those that are behind to the furthest ([`Message::State`]), and gives
//! each its rank. A process that is lost costs the step in hand and nothing else: nobody takes a step before it has
//! the gradients of all batches. If the leading one is lost, the others call anew.
//!
//! # Adding up
//! Every two processes keep a connection, too. Each process owns one part in N of the gradients: it gets that part of what
//! all others have, adds it up in the one order ([`picofarm_model::train::group::Blocks`]), and sends the sum to all. Each
//! process sends and receives 2 (N−1)/N of the gradients' bytes, which is the least that any exchange can do (Patarasuk and
//! Yuan, "Bandwidth optimal all-reduce algorithms", 2009).
//!
//! # Trust
//! Whoever can read the calls can join: each process has a secret of its own in them, and what comes without it is not read
//! further. Connections are not encrypted: they are for a network that one trusts, as those of NCCL and Gloo are.

#![forbid(unsafe_code)]

mod endpoint;
mod group;
mod link;
mod mesh;
mod message;

use serde::{Deserialize, Serialize};

pub use group::Members;

/// Where processes of one training find one another.
pub trait Rendezvous {
    /// The newest call and its number.
    ///
    /// # Errors
    /// Where the place cannot be reached, in words.
    fn newest(&self) -> Result<Option<(u64, Call)>, String>;

    /// Makes a call of this number; `false` where there is one already.
    ///
    /// # Errors
    /// As [`Self::newest`].
    fn make(&self, number: u64, call: &Call) -> Result<bool, String>;
}

/// Where a process that leads is reached.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Call {
    /// Address and port.
    pub address: String,
    /// What it wants to be shown.
    pub secret: String,
    /// The machine, for people.
    pub machine: String,
}
