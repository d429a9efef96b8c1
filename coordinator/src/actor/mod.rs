//! The task that owns the core. It receives commands, claims the tasks that workers want, lets the
//! core decide, and commits the outcome. It answers only after the commit. Commands that arrive
//! during a commit form the next batch.

mod command;
pub(crate) mod forget;
mod lanes;
mod life;
mod sessions;
mod slow_work;

pub(crate) use command::{Command, FromWorker, Refusal, Reply, Ruling, StoreCheck, Submitted};
pub(crate) use lanes::Lanes;
pub(crate) use life::Actor;
pub(crate) use sessions::HeartbeatQueue;
pub(crate) use slow_work::{Dispute, SlowWork};
