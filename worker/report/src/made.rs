//! The origin of models: lineage and settings.

use std::fmt::Write;

use super::{Entry, Report, text::Safe};

/// Returns the lineage as a table, with the entries that all models share separate from those that
/// differ, followed by each model's settings.
pub(super) fn made(report: &Report) -> String {
    let models = &report.models;
    let mut keys: Vec<&str> = Vec::new();
    for (key, _) in models.iter().flat_map(|m| &m.lineage) {
        if !keys.contains(&&**key) {
            keys.push(key);
        }
    }
    let same = |key: &str| {
        let first = models.first().and_then(|m| value(m, key));
        models.len() > 1 && first.is_some() && models.iter().all(|m| value(m, key) == first)
    };
    let (shared, own): (Vec<&str>, Vec<&str>) = keys.iter().partition(|key| same(key));
    let mut out = String::new();
    if keys.is_empty() {
        out.push_str("<p class=\"none\">These models have no lineage.</p>");
    }
    if !shared.is_empty() {
        out.push_str(
            "<div class=\"wide\"><table class=\"lineage\"><caption>All models</caption><tbody>",
        );
        for key in &shared {
            let of = models.first().and_then(|m| value(m, key)).unwrap_or("–");
            let _ = write!(
                out,
                "<tr><th scope=\"row\">{}</th><td>{}</td></tr>",
                Safe(key),
                Safe(of)
            );
        }
        out.push_str("</tbody></table></div>");
    }
    if !own.is_empty() {
        out.push_str("<div class=\"wide\"><table class=\"lineage\"><thead><tr><th>model</th>");
        for key in &own {
            let _ = write!(out, "<th>{}</th>", Safe(key));
        }
        out.push_str("</tr></thead><tbody>");
        for model in models {
            let _ = write!(out, "<tr><th scope=\"row\">{}</th>", Safe(&model.name));
            for key in &own {
                let _ = write!(out, "<td>{}</td>", Safe(value(model, key).unwrap_or("–")));
            }
            out.push_str("</tr>");
        }
        out.push_str("</tbody></table></div>");
    }
    for model in models {
        let settings = serde_json::json!({ "plan": model.plan, "data": model.data });
        let settings = serde_json::to_string_pretty(&settings).expect("plain data");
        let _ = write!(
            out,
            "<details><summary>Settings of {}</summary><pre>{}</pre></details>",
            Safe(&model.name),
            Safe(settings)
        );
    }
    out
}

fn value<'a>(model: &'a Entry, key: &str) -> Option<&'a str> {
    let line = model.lineage.iter().find(|(k, _)| k == key);
    line.map(|(_, value)| &**value)
}
