//! Values in the places of their names: wherever a job says `{name}`.

use serde_json::Value;

/// Puts `value` where `mark` stands: in place of a text that is nothing else, and into others as text.
pub(super) fn substitute(into: &mut Value, mark: &str, value: &Value) {
    match into {
        Value::String(text) if text == mark => *into = value.clone(),
        Value::String(text) => *text = text.replace(mark, &plain(value)),
        Value::Array(items) => items.iter_mut().for_each(|v| substitute(v, mark, value)),
        Value::Object(table) => table.values_mut().for_each(|v| substitute(v, mark, value)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

/// A value as text inside a text.
pub(super) fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}
