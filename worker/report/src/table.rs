//! The table of metrics: each experiment compared with trivial answers and published results.

use std::fmt::Write;

use super::{
    Group, Order, Report, Spread, Summary,
    number::{digits, metres, share, thousands},
    paper,
    summary::{Figures, TARGETS},
    text::Safe,
};
use picofarm_model::{
    input::{ShadowVariant, Target},
    net::{StemForm, TimeProjection},
};

/// Returns the name of a target.
pub(super) fn target_name(target: Target) -> &'static str {
    match target {
        Target::Tof => "Depth",
        Target::Shadow => "Shadows",
        Target::Specular => "Mirrors",
    }
}

/// Returns the name of a target's error, with its unit.
pub(super) fn error_name(target: Target) -> &'static str {
    match target {
        Target::Tof => "depth MAE (m)",
        Target::Shadow | Target::Specular => "1 − IoU",
    }
}

const BY_32: &str =
    "as the released code has it: of 32 masks together, averaged; 0 where there is nothing in them";
const BOUNDARY: &str =
    "as the released code has it: how many edges are where they are in truth, at any scale";

/// Returns the columns of a target's metrics, the main one first: name, heading, and an explanation
/// if the heading is not clear.
fn columns(target: Target) -> &'static [(&'static str, &'static str, &'static str)] {
    match target {
        Target::Tof => &[
            ("mae_m", "MAE (m)", ""),
            ("rmse_m", "RMSE (m)", ""),
            ("boundary_f1", "boundary F1", BOUNDARY),
        ],
        Target::Shadow | Target::Specular => &[
            ("iou", "IoU", ""),
            ("mae", "MAE", ""),
            ("f1", "F1", ""),
            ("iou_32", "IoU of 32", BY_32),
            ("mae_32", "MAE of 32", BY_32),
            ("f1_32", "F1 of 32", BY_32),
        ],
    }
}

/// Returns the name of the main metric.
pub(super) fn main_figure(target: Target) -> &'static str {
    columns(target)[0].0
}

/// Formats the mean ± spread of a metric, by its name.
pub(super) fn spread(name: &str, figure: Spread) -> String {
    let in_metres = name.ends_with("_m");
    let write = if in_metres { metres } else { share };
    let mean = write(figure.mean);
    match figure.deviation {
        Some(deviation) if in_metres => format!("{mean} ± {}", digits(deviation, 2)),
        Some(deviation) => format!("{mean} ± {}", share(deviation)),
        None => mean,
    }
}

/// Returns all tables.
pub(super) fn tables(report: &Report, summary: &Summary) -> String {
    let mut out = String::new();
    let missing = report
        .models
        .iter()
        .filter(|m| m.evaluated.is_none())
        .count();
    match (missing, report.models.len()) {
        (_, 0) => out.push_str("<p class=\"none\">There are no models in this report.</p>"),
        (0, _) => {}
        (n, all) if n == all => {
            out.push_str("<p class=\"warn\">No model of this report was evaluated: there are no figures on scenes that \
                they have not seen.</p>");
        }
        (n, all) => {
            let _ = write!(
                out,
                "<p class=\"warn\">Not evaluated: {n} of {all} models.</p>"
            );
        }
    }
    for target in TARGETS {
        let groups: Vec<&Group> = summary
            .groups
            .iter()
            .filter(|g| g.target == target)
            .collect();
        if !groups.is_empty() {
            let _ = write!(out, "<h3>{}</h3>", target_name(target));
            out.push_str(&table(report, target, &groups));
            out.extend(groups.iter().filter_map(|group| verdict(group)));
            for order in summary.orders.iter().filter(|o| o.target == target) {
                out.push_str(&ordered(order));
            }
        }
    }
    if summary.groups.iter().any(|g| g.repeats.is_some()) {
        let _ = write!(out, "<p class=\"note\">{}</p>", Safe(paper::NOTE));
    }
    out
}

/// Returns a line that compares an experiment with the best trivial answer.
pub(super) fn verdict(group: &Group) -> Option<String> {
    let (name, ratio) = group.beside_best_baseline.as_ref()?;
    let (class, better) = match *ratio < 1.0 {
        true => ("note", "better than every trivial answer"),
        false => ("warn", "no better than a trivial answer"),
    };
    let (label, name) = (Safe(&group.label), Safe(name));
    // A difference that two places hide is shown with four.
    let places = if (0.995..1.0).contains(ratio) { 4 } else { 2 };
    let ratio = digits(*ratio, places);
    Some(format!(
        "<p class=\"{class}\">{label}: {better}: {ratio} times the error of \u{201c}{name}\u{201d}.</p>"
    ))
}

/// Returns the table of one target.
pub(super) fn table(report: &Report, target: Target, groups: &[&Group]) -> String {
    let mut trivial: Vec<&String> = groups.iter().flat_map(|g| g.baselines.keys()).collect();
    trivial.sort_unstable();
    trivial.dedup();
    let published = groups.iter().any(|g| g.repeats.is_some());
    let main = main_figure(target);
    let mut out = String::from(
        "<div class=\"wide\"><table class=\"figures\"><thead><tr><th>experiment</th><th>seeds</th>",
    );
    for (_, heading, meaning) in columns(target) {
        let title = match *meaning {
            "" => String::new(),
            meaning => format!(" title=\"{}\"", Safe(meaning)),
        };
        let _ = write!(out, "<th class=\"n\"{title}>{heading}</th>");
    }
    for name in &trivial {
        let _ = write!(
            out,
            "<th class=\"n base\">{}:<br>{}</th>",
            Safe(name),
            columns(target)[0].1
        );
    }
    let _ = write!(
        out,
        "<th class=\"n\" title=\"error over that of the best trivial answer\">error ÷<br>best trivial</th>\
         <th class=\"n\" title=\"what 10, 50 and 90 % of single scenes stay below\">{} of scenes<br>10 · 50 · 90 %</th>",
        error_name(target)
    );
    if published {
        let _ = write!(
            out,
            "<th class=\"n paper\">published<br>{}</th>",
            columns(target)[0].1
        );
    }
    out.push_str("</tr></thead><tbody>");
    for group in groups {
        row(&mut out, report, group, main, &trivial, published);
    }
    out + "</tbody></table></div>"
}

fn row(
    out: &mut String,
    report: &Report,
    group: &Group,
    main: &str,
    trivial: &[&String],
    with_published: bool,
) {
    let target = group.target;
    let _ = write!(
        out,
        "<tr><th scope=\"row\">{}<small>{}</small></th><td>{}</td>",
        Safe(&group.label),
        Safe(sees(report, group)),
        seeds(group)
    );
    let cell = |figures: Option<&Figures>, name: &str| {
        let figure = figures.and_then(|f| f.get(name));
        figure.map_or_else(|| "–".to_owned(), |f| spread(name, *f))
    };
    if group.figures.is_empty() {
        let _ = write!(
            out,
            "<td class=\"none\" colspan=\"{}\">not evaluated</td>",
            columns(target).len()
        );
    } else {
        for (name, _, _) in columns(target) {
            let class = if *name == main { "n main" } else { "n" };
            let figure = cell(Some(&group.figures), name);
            let _ = write!(out, "<td class=\"{class}\">{figure}</td>");
        }
    }
    for name in trivial {
        let figure = cell(group.baselines.get(*name), main);
        // On the same scenes, trivial answers always have the same metrics.
        let figure = figure
            .trim_end_matches(" ± 0")
            .trim_end_matches(" ± 0.0000");
        let _ = write!(out, "<td class=\"n base\">{figure}</td>");
    }
    let none = || "–".to_owned();
    let beside = match &group.beside_best_baseline {
        Some((name, ratio)) => format!("{}<small>of {}</small>", digits(*ratio, 2), Safe(name)),
        None => none(),
    };
    let errors = group.scene_errors;
    let errors = errors.map_or_else(none, |e| e.map(|e| digits(e, 2)).join(" · "));
    let _ = write!(
        out,
        "<td class=\"n\">{beside}</td><td class=\"n\">{errors}</td>"
    );
    if with_published {
        let published = shown(target, group);
        let _ = write!(out, "<td class=\"n paper\">{published}</td>");
    }
    out.push_str("</tr>");
}

fn shown(target: Target, group: &Group) -> String {
    let published = match (group.published, group.repeats) {
        (Some(published), _) => published,
        (None, None) => return "–".to_owned(),
        (None, Some(repeats)) => {
            let (experiment, unlike) = (repeats.experiment, group.unlike.join(", "));
            return format!(
                "–<small>{}, but {}</small>",
                Safe(experiment),
                Safe(&unlike)
            );
        }
    };
    let figures = match (target, published.mae, published.iou) {
        (Target::Tof, Some(mae), _) => mae.to_string(),
        (_, mae, Some(iou)) => {
            let mae = mae.map_or_else(String::new, |mae| format!("<small>MAE {mae}</small>"));
            format!("{iou:.3}{mae}")
        }
        _ => "–".to_owned(),
    };
    format!("{figures}<small>{}</small>", Safe(published.experiment))
}

fn seeds(group: &Group) -> String {
    let count = group.seeds.len();
    let list: Vec<String> = group.seeds.iter().map(u64::to_string).collect();
    let again = match group.models.len() {
        runs if runs > count => format!("; {runs} runs"),
        _ => String::new(),
    };
    format!("{count} <small>({}{again})</small>", list.join(", "))
}

/// Describes an experiment in a line.
pub(super) fn sees(report: &Report, group: &Group) -> String {
    let entry = &report.models[group.models[0]];
    let (question, net) = (&entry.plan.question, &entry.plan.net);
    let mut words = vec![match (&question.evidence, question.intensity_only) {
        (Some(form), _) => format!("{} planes", form.planes.len()),
        (None, true) => "intensity only".to_owned(),
        (None, false) => format!("{} bins", question.bins),
    }];
    if question.target == Target::Shadow {
        let variant = match question.variant {
            ShadowVariant::Concat => "concat",
            ShadowVariant::Difference => "difference",
            ShadowVariant::Index => "index",
            ShadowVariant::All => "all spots at once",
            ShadowVariant::Evidence => "evidence",
        };
        words.extend([variant.to_owned(), format!("{} spots", question.spots)]);
        if question.variant == ShadowVariant::All {
            // The other variants learn from one mask a visit.
            words.push(format!("{} masks a visit", question.spots));
        }
    }
    match entry.data.max_bounces {
        0 => {}
        2 => words.push("two bounces only".to_owned()),
        n => words.push(format!("{n} bounces at most")),
    }
    if entry.data.noise {
        words.push("photon noise".to_owned());
    }
    let architecture = net.describe();
    let stem = match (net.stem, net.stem_form) {
        (0, _) => String::new(),
        (width, StemForm::Block) => format!(", stem {width}"),
        (width, StemForm::Linear) => format!(", linear stem {width}"),
    };
    let projection = match net.time_projection {
        TimeProjection::Shared => "",
        TimeProjection::Each => ", a projection of time for each stream",
    };
    let frozen = if net.frozen { ", frozen encoder" } else { "" };
    words.push(format!("{architecture}{stem}{projection}{frozen}"));
    words.extend(
        entry
            .data
            .scenes
            .map(|n| format!("{} scenes", thousands(n))),
    );
    words.extend(entry.conditions.iter().map(|(k, v)| format!("{k}: {v}")));
    words.join(" · ")
}

fn ordered(order: &Order) -> String {
    let mut out = format!(
        "<p>Order: {} of {} pairs of experiments stand as published",
        order.kept, order.pairs
    );
    if order.close > 0 {
        let _ = write!(out, "; within the spread of their seeds: {}", order.close);
    }
    out.push('.');
    let turned = order.turned.iter().map(|[better, worse]| {
        format!(
            "<b>{}</b> is better than <b>{}</b>",
            Safe(better),
            Safe(worse)
        )
    });
    let turned: Vec<String> = turned.collect();
    if !turned.is_empty() {
        let _ = write!(out, " Not as published: {}.", turned.join("; "));
    }
    out + "</p>"
}
