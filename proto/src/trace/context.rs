//! W3C Trace Context: the text, and the span that it names.

use opentelemetry::{
    Context,
    trace::{SpanContext, SpanId, TraceContextExt, TraceFlags, TraceId, TraceState},
};
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// Returns the context with which others continue a span; empty if the span belongs to no trace.
pub fn traceparent(span: &Span) -> String {
    if span.is_disabled() {
        return String::new();
    }
    let context = span.context();
    let place = context.span().span_context().clone();
    if !place.is_valid() {
        return String::new();
    }
    let flags = place.trace_flags().to_u8();
    format!("00-{}-{}-{flags:02x}", place.trace_id(), place.span_id())
}

/// Makes a span the child of the span named by `traceparent`, from this process or another. If the
/// text is invalid, the span begins a trace of its own.
pub fn join(span: &Span, traceparent: &str) {
    if span.is_disabled() {
        return;
    }
    if let Some(place) = parse(traceparent) {
        // An error means that there is no OpenTelemetry layer, and therefore no trace to join.
        let _ = span.set_parent(Context::new().with_remote_span_context(place));
    }
}

/// Parses version 00 of the format only, because this program writes no other.
fn parse(traceparent: &str) -> Option<SpanContext> {
    let mut parts = traceparent.split('-');
    let (version, trace, span, flags) =
        (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
    if version != "00" || (trace.len(), span.len(), flags.len()) != (32, 16, 2) {
        return None;
    }
    let place = SpanContext::new(
        TraceId::from_hex(trace).ok()?,
        SpanId::from_hex(span).ok()?,
        TraceFlags::new(u8::from_str_radix(flags, 16).ok()?),
        true,
        TraceState::NONE,
    );
    (place.is_valid() && parts.next().is_none()).then_some(place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::TARGET;

    #[test]
    fn a_traceparent_is_read_as_the_standard_writes_it_and_nothing_else_is() {
        let good = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";
        let place = parse(good).unwrap();
        assert_eq!(
            place.trace_id().to_string(),
            "0af7651916cd43dd8448eb211c80319c"
        );
        assert_eq!(place.span_id().to_string(), "b7ad6b7169203331");
        assert!(place.is_sampled() && place.is_remote());
        for bad in [
            "",
            "00",
            "01-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-00000000000000000000000000000000-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01-x",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b71692033ü-01",
        ] {
            assert_eq!(parse(bad), None, "{bad}");
        }
    }

    #[test]
    fn without_a_layer_for_traces_there_is_no_traceparent() {
        let span = tracing::info_span!(target: TARGET, "task");
        join(
            &span,
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
        );
        assert_eq!(traceparent(&span), "");
    }
}
