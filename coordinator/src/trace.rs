//! The coordinator's spans in traces: a lease begins a trace, and the commit of each of its tasks ends its branch. See
//! [`picofarm_proto::trace`].

use picofarm_proto::{model::Finished, trace};
use tracing::{Level, Span, debug_span, enabled};

use crate::core::{Say, SessionId};

/// A span for each lease among what is about to be made durable and said; the leases carry them on.
pub(crate) fn grants(say: &mut [(SessionId, Say)]) -> Vec<Span> {
    if !enabled!(target: trace::TARGET, Level::DEBUG) {
        return Vec::new();
    }
    let mut spans = Vec::new();
    for (_, said) in say {
        if let Say::Lease(lease) = said {
            let span = debug_span!(target: trace::TARGET, parent: None, "grant", job = %lease.job,
                stage = &*lease.stage.name, lo = lease.lo, hi = lease.hi, range = %lease.lease.range);
            lease.traceparent = trace::traceparent(&span);
            spans.push(span);
        }
    }
    spans
}

/// A span for a reported task, as the next one of the task's own.
pub(crate) fn commit(report: &Finished) -> Option<Span> {
    if !enabled!(target: trace::TARGET, Level::DEBUG) {
        return None;
    }
    let span = debug_span!(target: trace::TARGET, parent: None, "commit", task = report.index,
        adopted = report.adopted);
    trace::join(&span, &report.traceparent);
    Some(span)
}
