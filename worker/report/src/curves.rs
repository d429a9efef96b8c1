//! Curves: training loss and validation metric over epochs.

use super::{
    Entry, Group, Report, Summary,
    chart::{Axis, Series, chart, legend},
    number::short,
    summary::TARGETS,
    table::{error_name, target_name},
};
use picofarm_model::{
    input::Target,
    metric::Metrics,
    train::{Line, epochs_at},
};

/// Returns the charts of all targets.
pub(super) fn curves(report: &Report, summary: &Summary) -> String {
    let mut out = String::new();
    for target in TARGETS {
        let groups: Vec<&Group> = summary
            .groups
            .iter()
            .filter(|g| g.target == target)
            .collect();
        if groups.is_empty() {
            continue;
        }
        let of = |value: &dyn Fn(&Entry, &Line) -> f64| series(report, &groups, value);
        let (loss, label) = match target {
            Target::Tof => {
                let metres = |entry: &Entry, line: &Line| {
                    line.loss * f64::from(entry.plan.question.depth_scale_m)
                };
                (of(&metres), "training L1 (m)")
            }
            Target::Shadow | Target::Specular => {
                (of(&|_, line| line.loss), "training cross-entropy (nats)")
            }
        };
        let seen = of(&|_, line| line.validation.as_ref().map_or(f64::NAN, Metrics::loss));
        let name = target_name(target);
        let validation = format!("validation {}", error_name(target));
        out.push_str("<div class=\"charts\">");
        out.push_str(&over_epochs(
            &format!("{name}: training loss"),
            label,
            &loss,
        ));
        out.push_str(&over_epochs(
            &format!("{name}: validation"),
            &validation,
            &seen,
        ));
        out.push_str("</div>");
        out.push_str(&legend(
            groups.iter().enumerate().map(|(i, g)| (i, &*g.label)),
        ));
    }
    out
}

fn over_epochs(title: &str, label: &str, series: &[Series]) -> String {
    let values = || series.iter().flat_map(|s| &s.points).map(|p| p.1);
    let log = wide(values());
    let x = Axis {
        label: "epoch",
        log: false,
        zero: true,
        write: |v| {
            if v.fract() == 0.0 {
                short(v)
            } else {
                String::new()
            }
        },
    };
    let y = Axis {
        label,
        log,
        zero: true,
        write: short,
    };
    chart(title, &x, &y, series)
}

/// Returns whether values are all positive and span so wide a range that small ones would be
/// invisible.
fn wide(values: impl Iterator<Item = f64>) -> bool {
    let (mut low, mut high) = (f64::INFINITY, 0f64);
    for v in values.filter(|v| v.is_finite()) {
        (low, high) = (low.min(v), high.max(v));
    }
    low > 0.0 && high > 5.0 * low
}

/// Returns a line for each model, in its experiment's colour.
fn series(report: &Report, groups: &[&Group], value: &dyn Fn(&Entry, &Line) -> f64) -> Vec<Series> {
    let mut out = Vec::new();
    for (style, group) in groups.iter().enumerate() {
        for model in &group.models {
            let entry = &report.models[*model];
            let points = epochs_at(&entry.history).map(|(at, line)| (at, value(entry, line), 0.0));
            out.push(Series {
                label: entry.name.clone(),
                style,
                points: points.collect(),
                joined: true,
                marks: false,
            });
        }
    }
    out
}
