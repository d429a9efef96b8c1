//! `picofarm config`: shows the settings and the source of each.

use crate::{
    args,
    output::{Output, table},
    settings::Resolved,
};

/// Shows the settings in effect, without secrets.
pub fn show(resolved: &Resolved, output: Output) {
    let values = serde_json::to_value(&resolved.settings).expect("settings are plain data");
    let mut rows: Vec<_> = resolved
        .sources
        .iter()
        .map(|(name, source)| {
            let value = match &values[name] {
                serde_json::Value::Null => String::new(),
                serde_json::Value::String(text) => args::without_secrets(text),
                other => other.to_string(),
            };
            vec![(*name).to_owned(), value, source.clone()]
        })
        .collect();
    if resolved.token {
        let source = "environment PICOFARM_TOKEN".to_owned();
        rows.push(vec!["token".into(), "(a secret)".into(), source]);
    }
    let document: serde_json::Map<_, _> = rows
        .iter()
        .map(|r| {
            (
                r[0].clone(),
                serde_json::json!({"value": r[1], "source": r[2]}),
            )
        })
        .collect();
    output.result(&document, || table(&rows));
}
