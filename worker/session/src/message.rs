//! The session's messages in checked types; protobuf goes no further than this file and its parent.

use picofarm_proto::{
    ids::LeaseRef,
    model::{Failure, Finished, Lease, TaskLog, TaskProgress, bounds},
    wire::{self, session_request, session_response},
};

/// What the worker says.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Outgoing {
    /// It can take this many more leases.
    Credit(u32),
    /// It lives, holds these leases and is so far with its task.
    Heartbeat {
        /// Leases held.
        leases: Vec<LeaseRef>,
        /// The task in hand.
        progress: Vec<TaskProgress>,
        /// Milliseconds until the worker must end; 0 = not known.
        ends_in_ms: u64,
    },
    /// What the task in hand has logged.
    Log(TaskLog),
    /// Something that must be acknowledged.
    Report(Report),
}

/// What must be acknowledged.
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
        /// Why, for people.
        reason: String,
    },
}

/// What the coordinator says.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Incoming {
    /// Work.
    Lease(Box<Lease>),
    /// A lease whose content cannot be used, with the reason.
    UnusableLease(Option<LeaseRef>, String),
    /// Answer to a report.
    Acknowledge {
        /// The lease it was about.
        lease: LeaseRef,
        /// The task; 0 for a release.
        index: u64,
        /// Whether it counts.
        accepted: bool,
        /// Why not.
        reason: String,
    },
    /// Answer to a heartbeat: these live on.
    Renewed {
        /// Leases still held.
        leases: Vec<LeaseRef>,
        /// Their time to live.
        ttl_ms: u32,
    },
    /// A lease is not wanted any more.
    Revoke {
        /// The lease.
        lease: LeaseRef,
        /// Why, for people.
        reason: String,
    },
    /// Of this lease, tasks from `hi` on are another worker's.
    Trim {
        /// The lease.
        lease: LeaseRef,
        /// Its new end.
        hi: u64,
    },
    /// Finish what is in hand, and end.
    Drain,
    /// A message that says nothing this version understands.
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
    /// Every message maps to something; what cannot be used says why.
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
            Some(M::Welcome(_)) => Incoming::Unknown("a second welcome".into()),
            None => Incoming::Unknown("an empty message".into()),
        }
    }
}
