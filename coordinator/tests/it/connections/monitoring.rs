//! Tests that the dashboard and the alerts in `deploy/monitoring` use metrics that exist.

use std::{collections::BTreeMap, fs, path::Path};

use super::pages::{answer, body, start};

/// A use of a metric: its name, and what is compared with each label.
type Used = (String, Vec<(String, String)>);

fn file(name: &str) -> String {
    let crate_folder = std::env::var("CARGO_MANIFEST_DIR").unwrap();
    let path = Path::new(&crate_folder)
        .join("../deploy/monitoring")
        .join(name);
    fs::read_to_string(path).unwrap()
}

/// Returns every metric in a text, with the label matchers after it.
fn used(text: &str) -> Vec<Used> {
    let mut found = Vec::new();
    for (at, _) in text.match_indices("picofarm_") {
        let rest = &text[at..];
        let named = |c: char| c.is_ascii_lowercase() || c == '_';
        let end = rest.find(|c| !named(c)).unwrap_or(rest.len());
        let (name, rest) = rest.split_at(end);
        let labels = rest.strip_prefix('{').and_then(|r| r.split_once('}'));
        let labels = labels.map_or("", |(labels, _)| labels);
        let labels = labels.split(',').filter_map(|label| {
            let (name, values) = label.split_once('=')?;
            let values = values.trim_matches(|c| "~\\\"".contains(c));
            Some((name.trim_end_matches('!').to_owned(), values.to_owned()))
        });
        found.push((name.to_owned(), labels.collect()));
    }
    found
}

/// Returns the label values of each sample on the page.
fn samples(page: &str) -> BTreeMap<&str, Vec<&str>> {
    let mut samples: BTreeMap<_, Vec<_>> = BTreeMap::new();
    for line in page.lines().filter(|line| !line.starts_with('#')) {
        let end = line.find(['{', ' ']).unwrap();
        samples.entry(&line[..end]).or_default().push(&line[end..]);
    }
    samples
}

#[tokio::test]
async fn the_dashboard_and_the_alerts_use_metrics_and_labels_of_the_page() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    let page = answer(&running, "GET /metrics HTTP/1.1\r\n\r\n").await;
    let samples = samples(body(&page));
    for (name, least) in [
        ("grafana-dashboard.json", 25),
        ("prometheus-alerts.yaml", 12),
    ] {
        let used = used(&file(name));
        assert!(used.len() >= least, "{name}: {used:?}");
        for (metric, labels) in used {
            let lines = samples.get(&*metric);
            let lines = lines.unwrap_or_else(|| panic!("{name}: {metric} is not on the page"));
            for (label, values) in labels.iter().filter(|(label, _)| label != "job") {
                for value in values.split('|') {
                    let sample = format!("{label}=\"{value}\"");
                    let known = lines.iter().any(|line| line.contains(&sample));
                    assert!(known, "{name}: {metric} has no {sample}");
                }
            }
        }
    }
}

#[test]
fn the_dashboard_is_json_with_a_target_in_each_panel() {
    let dashboard: serde_json::Value =
        serde_json::from_str(&file("grafana-dashboard.json")).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    assert!(panels.len() > 10);
    for panel in panels {
        let targets = panel["targets"].as_array().unwrap();
        let exprs = targets.iter().map(|t| t["expr"].as_str().unwrap());
        assert!(exprs.clone().count() > 0 && exprs.clone().all(|e| e.contains("picofarm_")));
        for expr in exprs {
            assert_eq!(
                expr.matches('(').count(),
                expr.matches(')').count(),
                "{expr}"
            );
        }
    }
}

#[test]
fn each_alert_has_a_severity_and_a_remedy() {
    let text = file("prometheus-alerts.yaml");
    let alerts: Vec<&str> = text.split("- alert: ").skip(1).collect();
    assert!(alerts.len() >= 8);
    for alert in alerts {
        for part in ["expr: ", "severity: ", "summary: ", "description: "] {
            assert!(alert.contains(part), "{part} is missing in {alert}");
        }
    }
}
