//! Replaces names by values: every `{name}` in a job.

use serde_json::Value;

/// Replaces `mark` by `value`. A text equal to the mark becomes the value itself; inside a longer
/// text the value is inserted as text.
pub(super) fn substitute(into: &mut Value, mark: &str, value: &Value) {
    match into {
        Value::String(text) if text == mark => *into = value.clone(),
        Value::String(text) => *text = text.replace(mark, &plain(value)),
        Value::Array(items) => items.iter_mut().for_each(|v| substitute(v, mark, value)),
        Value::Object(table) => table.values_mut().for_each(|v| substitute(v, mark, value)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

/// Returns a value as text for insertion into a longer text.
pub(super) fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}
