//! Shows what the coordinator does: metrics, health, the audit log and trace spans.

pub(crate) mod audit;
pub(crate) mod health;
pub(crate) mod metrics;
pub(crate) mod trace;
