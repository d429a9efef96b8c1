//! Trade-offs: speed, size and multiply-adds against error, and error against the number of scenes.

use std::fmt::Write;

use super::{
    Entry, Group, Report, Scaling, Spread, Summary,
    chart::{Axis, Series, chart, legend},
    number::{digits, duration, prefixed, prefixed_short, short, thousands},
    summary::TARGETS,
    table::{error_name, main_figure, spread, target_name},
    text::Safe,
};

/// The horizontal value of an experiment in a panel.
type Across<'a> = &'a dyn Fn(&Group) -> Option<f64>;

/// Returns the charts of speed against error.
pub(super) fn speed(report: &Report, summary: &Summary) -> String {
    let mut out = String::new();
    for target in TARGETS {
        let groups: Vec<&Group> = summary
            .groups
            .iter()
            .filter(|g| g.target == target)
            .collect();
        if groups.iter().all(|g| g.error.is_none()) {
            continue;
        }
        let first = |g: &Group| -> &Entry { &report.models[g.models[0]] };
        let panels: [(&str, Across); 3] = [
            ("samples/s in training", &|g| Some(g.samples_per_s?.mean)),
            ("parameters", &|g| Some(first(g).parameters as f64)),
            ("multiply-adds an image", &|g| first(g).multiply_adds),
        ];
        out.push_str("<div class=\"charts three\">");
        for (label, of) in panels {
            let points = groups.iter().enumerate().filter_map(|(style, g)| {
                let (x, error) = (of(g)?, g.error?);
                Some(Series {
                    label: format!(
                        "{}: {}, {}",
                        g.label,
                        prefixed(x),
                        spread(main_figure(target), error)
                    ),
                    style,
                    points: vec![point(x, error)],
                    joined: false,
                    marks: true,
                })
            });
            let points: Vec<Series> = points.collect();
            let title = format!("{}: error against {label}", target_name(target));
            out.push_str(&both_log(
                &title,
                label,
                prefixed_short,
                error_name(target),
                &points,
            ));
        }
        out.push_str("</div>");
        out.push_str(&legend(
            groups.iter().enumerate().map(|(i, g)| (i, &*g.label)),
        ));
    }
    out + &costs(report, summary)
}

fn point(x: f64, error: Spread) -> (f64, f64, f64) {
    (x, error.mean, error.deviation.unwrap_or(0.0))
}

fn both_log(title: &str, x: &str, write: fn(f64) -> String, y: &str, series: &[Series]) -> String {
    let axis = |label, write| Axis {
        label,
        log: true,
        zero: false,
        write,
    };
    chart(title, &axis(x, write), &axis(y, short), series)
}

/// Returns a table of each experiment's cost.
fn costs(report: &Report, summary: &Summary) -> String {
    if summary.groups.is_empty() {
        return String::new();
    }
    let mut out = String::from(
        "<div class=\"wide\"><table><thead><tr><th>experiment</th><th>target</th><th class=\"n\">parameters</th>\
         <th class=\"n\">multiply-adds<br>an image</th><th class=\"n\">samples/s<br>in training</th>\
         <th class=\"n\">training time</th><th class=\"n\">error</th></tr></thead><tbody>",
    );
    for group in &summary.groups {
        let entry = &report.models[group.models[0]];
        let none = || "–".to_owned();
        let seconds = group
            .models
            .iter()
            .filter_map(|i| report.models[*i].speed?.seconds);
        let seconds = Spread::from_values(&seconds.collect::<Vec<_>>());
        let speed = group
            .samples_per_s
            .map_or_else(none, |s| match s.deviation {
                Some(deviation) => format!("{} ± {}", digits(s.mean, 3), digits(deviation, 2)),
                None => digits(s.mean, 3),
            });
        let error = match group.error {
            Some(error) => format!(
                "{} {}",
                spread(main_figure(group.target), error),
                unit(group)
            ),
            None => "not evaluated".to_owned(),
        };
        let _ = write!(
            out,
            "<tr><th scope=\"row\">{}</th><td>{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td>\
             <td class=\"n\">{speed}</td><td class=\"n\">{}</td><td class=\"n\">{error}</td></tr>",
            Safe(&group.label),
            target_name(group.target),
            thousands(entry.parameters),
            entry.multiply_adds.map_or_else(none, prefixed),
            seconds.map_or_else(none, |s| duration(s.mean)),
        );
    }
    out + "</tbody></table></div><p class=\"note\">Means over seeds. Multiply-adds are of a pass forward, one-hot inputs \
        counted as dense ones; they are stated for 2D networks.</p>"
}

fn unit(group: &Group) -> &'static str {
    if group.target == picofarm_model::input::Target::Tof {
        "m"
    } else {
        "(1 − IoU)"
    }
}

/// Returns the charts of error against the number of scenes.
pub(super) fn scale(summary: &Summary) -> String {
    if summary.scalings.is_empty() {
        return "<p class=\"none\">No two evaluated experiments differ only in the number of scenes to learn from.</p>"
            .to_owned();
    }
    let mut out = String::new();
    for target in TARGETS {
        let of: Vec<&Scaling> = summary
            .scalings
            .iter()
            .filter(|s| s.target == target)
            .collect();
        if of.is_empty() {
            continue;
        }
        let series = of.iter().enumerate().map(|(style, s)| Series {
            label: s.label.clone(),
            style,
            points: s
                .points
                .iter()
                .map(|(n, error)| point(*n as f64, *error))
                .collect(),
            joined: true,
            marks: true,
        });
        let series: Vec<Series> = series.collect();
        let axis = |label, log, write| Axis {
            label,
            log,
            zero: true,
            write,
        };
        let title = format!("{}: error against scenes", target_name(target));
        out.push_str("<div class=\"charts\">");
        let x = axis("scenes to learn from", true, short);
        out.push_str(&chart(
            &title,
            &x,
            &axis(error_name(target), false, short),
            &series,
        ));
        out.push_str("<table><thead><tr><th>experiment</th><th class=\"n\">scenes</th><th class=\"n\">error</th></tr></thead><tbody>");
        for (scaling, (scenes, error)) in
            of.iter().flat_map(|s| s.points.iter().map(move |p| (s, p)))
        {
            let _ = write!(
                out,
                "<tr><th scope=\"row\">{}</th><td class=\"n\">{}</td><td class=\"n\">{}</td></tr>",
                Safe(&scaling.label),
                thousands(*scenes),
                spread(main_figure(target), *error)
            );
        }
        out.push_str("</tbody></table></div>");
        out.push_str(&legend(of.iter().enumerate().map(|(i, s)| (i, &*s.label))));
    }
    out
}
