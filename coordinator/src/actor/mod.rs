//! The task that owns the core. It receives commands, claims the tasks that workers want, lets the
//! core decide, and commits the outcome. It answers only after the commit. Commands that arrive
//! during a commit form the next batch.

mod aside;
mod command;
pub(crate) mod forget;
mod lanes;
mod life;
mod sessions;

pub(crate) use aside::{Aside, Dispute};
pub(crate) use command::{Command, FromWorker, Refusal, Reply, Ruling, Submitted, Verdict};
pub(crate) use lanes::Lanes;
pub(crate) use life::Actor;
pub(crate) use sessions::Waiting;
