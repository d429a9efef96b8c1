//! Makes reasons and counts for explanations.

use picofarm_proto::messages::Reason;

/// Returns a reason without an end.
pub(super) fn reason(code: &str, tasks: u64, words: String) -> Reason {
    Reason {
        code: code.into(),
        tasks,
        words,
        until_ms: None,
    }
}

/// Formats a count: "1 task", "3 tasks".
pub(super) fn n(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}
