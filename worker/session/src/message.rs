//! The session's messages as checked types. Protobuf types are only used in this file and its
//! parent.

use picofarm_proto::{
    ids::LeaseRef,
    messages::{Examine, Examined, Failure, Finished, Lease, TaskLog, TaskProgress},
    spec::bounds,
    wire::{self, session_request, session_response},
};

/// A message from the worker.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Outgoing {
    /// The worker accepts this number of further leases.
    Credit(u32),
    /// The worker is alive, has these leases and has made this progress.
    Heartbeat {
        /// The worker's leases.
        leases: Vec<LeaseRef>,
        /// Progress of the running tasks.
        progress: Vec<TaskProgress>,
        /// Milliseconds until the worker must end; 0 = unknown.
        ends_in_ms: u64,
    },
    /// Log lines of the running task.
    Log(TaskLog),
    /// The answer to an examination.
    Examined(Examined),
    /// A report that must be acknowledged.
    Report(Report),
}

/// A report that must be acknowledged.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Report {
    /// A task is finished and published.
    Done(Finished),
    /// A task failed.
    Failed(Failure),
    /// A lease is given back.
    Release {
        /// The lease.
        lease: LeaseRef,
        /// The reason, for people.
        reason: String,
    },
}

/// A message from the coordinator.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Incoming {
    /// A new lease.
    Lease(Box<Lease>),
    /// A lease with unusable content, with the reason.
    UnusableLease(Option<LeaseRef>, String),
    /// The answer to a report.
    Acknowledge {
        /// The report's lease.
        lease: LeaseRef,
        /// The task; 0 for a release.
        index: u64,
        /// Whether the report was accepted.
        accepted: bool,
        /// The reason for a rejection.
        reason: String,
    },
    /// The answer to a heartbeat: these leases are renewed.
    Renewed {
        /// The renewed leases.
        leases: Vec<LeaseRef>,
        /// Their lifetime in milliseconds.
        ttl_ms: u32,
    },
    /// A lease is no longer wanted.
    Revoke {
        /// The lease.
        lease: LeaseRef,
        /// The reason, for people.
        reason: String,
    },
    /// The tasks of this lease from `hi` on were moved to another worker.
    Trim {
        /// The lease.
        lease: LeaseRef,
        /// The new end of its tasks.
        hi: u64,
    },
    /// Finish the running task, and end.
    Drain,
    /// Check this machine.
    Examine(Examine),
    /// A message that this version does not understand.
    Unknown(String),
}

impl From<Outgoing> for wire::SessionRequest {
    fn from(message: Outgoing) -> Self {
        use session_request::Message as M;
        let message = match message {
            Outgoing::Credit(leases) => M::Credit(wire::Credit { leases }),
            Outgoing::Heartbeat {
                leases,
                progress,
                ends_in_ms,
            } => M::Heartbeat(wire::Heartbeat {
                ends_in_ms,
                leases: leases.into_iter().map(Into::into).collect(),
                progress: progress.into_iter().map(Into::into).collect(),
            }),
            Outgoing::Log(log) => M::Log(log.into()),
            Outgoing::Examined(examined) => M::Examined(examined.into()),
            Outgoing::Report(Report::Done(done)) => M::Done(done.into()),
            Outgoing::Report(Report::Failed(failed)) => M::Failed(failed.into()),
            Outgoing::Report(Report::Release { lease, reason }) => M::Release(wire::Release {
                lease: Some(lease.into()),
                reason: bounds::message(&reason),
            }),
        };
        Self {
            message: Some(message),
        }
    }
}

impl Incoming {
    /// Converts a message. Every message maps to a variant; an unusable one maps to a variant with
    /// the reason.
    pub(crate) fn from_wire(response: wire::SessionResponse) -> Self {
        use session_response::Message as M;
        let lease = |r: Option<wire::LeaseRef>| r.and_then(|r| LeaseRef::try_from(r).ok());
        match response.message {
            Some(M::Lease(w)) => {
                let named = lease(w.lease.clone());
                match Lease::try_from(w) {
                    Ok(l) => Incoming::Lease(Box::new(l)),
                    Err(e) => Incoming::UnusableLease(named, e.to_string()),
                }
            }
            Some(M::Acknowledge(w)) => match lease(w.lease) {
                Some(lease) => Incoming::Acknowledge {
                    lease,
                    index: w.index,
                    accepted: w.accepted,
                    reason: w.reason,
                },
                None => Incoming::Unknown("an acknowledgement without a lease".into()),
            },
            Some(M::Renewed(w)) => Incoming::Renewed {
                leases: w
                    .leases
                    .into_iter()
                    .filter_map(|r| lease(Some(r)))
                    .collect(),
                ttl_ms: w.ttl_ms,
            },
            Some(M::Revoke(w)) => match lease(w.lease) {
                Some(lease) => Incoming::Revoke {
                    lease,
                    reason: w.reason,
                },
                None => Incoming::Unknown("a revocation without a lease".into()),
            },
            Some(M::Trim(w)) => match lease(w.lease) {
                Some(lease) => Incoming::Trim { lease, hi: w.hi },
                None => Incoming::Unknown("a trimming without a lease".into()),
            },
            Some(M::Drain(_)) => Incoming::Drain,
            Some(M::Examine(w)) => Incoming::Examine(w.into()),
            Some(M::Welcome(_)) => Incoming::Unknown("a second welcome".into()),
            None => Incoming::Unknown("an empty message".into()),
        }
    }
}
