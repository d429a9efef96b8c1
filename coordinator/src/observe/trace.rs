//! The coordinator's trace spans. A lease begins a trace, and the commit of each of its tasks ends
//! a branch. See [`picofarm_proto::trace`].

use picofarm_proto::{messages::Finished, trace};
use tracing::{Level, Span, debug_span, enabled};

use crate::core::{SessionId, ToWorker};

/// Creates a span for each lease about to be committed and sent. The lease messages carry it.
pub(crate) fn grants(say: &mut [(SessionId, ToWorker)]) -> Vec<Span> {
    if !enabled!(target: trace::TARGET, Level::DEBUG) {
        return Vec::new();
    }
    let mut spans = Vec::new();
    for (_, said) in say {
        if let ToWorker::Lease(lease) = said {
            let span = debug_span!(target: trace::TARGET, parent: None, "grant", job = %lease.job,
                stage = &*lease.stage.name, lo = lease.lo, hi = lease.hi, range = %lease.lease.range);
            lease.traceparent = trace::traceparent(&span);
            spans.push(span);
        }
    }
    spans
}

/// Creates a span for a reported task, as the child of the task's own span.
pub(crate) fn commit(report: &Finished) -> Option<Span> {
    if !enabled!(target: trace::TARGET, Level::DEBUG) {
        return None;
    }
    let span = debug_span!(target: trace::TARGET, parent: None, "commit", task = report.index,
        adopted = report.adopted);
    trace::join(&span, &report.traceparent);
    Some(span)
}
