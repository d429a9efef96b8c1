//! Explains why a job's tasks do not run, and the history of one task, from the facts given. Pure.

mod facts;
mod job;
mod reason;
mod task;
#[cfg(test)]
mod tests;
mod waits;

pub(crate) use facts::{JobFacts, TaskFacts};
pub(crate) use job::job;
pub(crate) use task::{committed, task};
