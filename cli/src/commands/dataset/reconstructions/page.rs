//! The page about reconstructions: a self-contained HTML file.

use std::fmt::Write;

use picofarm_figures::{
    STYLE, data_url,
    number::{digits, thousands},
    text::Safe,
};
use serde_json::Value;

use super::report::{Group, Report, Spread};
use crate::output::bytes;

/// Columns of the table: the figure's name in `dataset info`, heading, unit.
const COLUMNS: [(&str, &str, &str); 11] = [
    ("l1_m", "L1", "m"),
    ("rmse_m", "RMSE", "m"),
    ("psnr_db", "PSNR", "dB"),
    ("visible_l1_m", "visible, L1", "m"),
    ("occluded_l1_m", "occluded, L1", "m"),
    ("outside_l1_m", "outside, L1", "m"),
    ("within_view_l1_m", "within view, L1", "m"),
    ("specular_l1_m", "specular, L1", "m"),
    ("chamfer_m", "Chamfer", "m"),
    ("f_score", "F-score", "at 5 cm"),
    ("floaters_m3", "floaters", "m³"),
];

const CLASSES: &str = "Errors of novel views are of the distance along the ray, mean ± standard error over scenes. \
    Visible: the measuring camera sees the surface too. Occluded: it is within that camera's view, and something hides it. \
    Outside: it is outside that view. Within view: visible and occluded together. Specular: the surface is a mirror, wherever it is; \
    its pixels are in no other column, neither in L1, RMSE nor PSNR. A dash: nothing was measured.";

/// Formats the report as a page.
pub(super) fn html(report: &Report) -> String {
    let sections = [
        ("Novel views and meshes", table(report)),
        ("Published figures", published(report)),
        ("Best, median and worst scene", extremes(report)),
        ("Settings", settings(report)),
    ];
    let sections =
        sections.map(|(name, body)| format!("<section><h2>{name}</h2>{body}</section>\n"));
    let (title, date) = (Safe(&report.title), Safe(&report.date));
    let scenes: usize = report.groups.iter().map(|g| g.scenes).sum();
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>{title}</title>\n<style>{STYLE}</style></head>\n<body>\
         <header><h1>{title}</h1><p class=\"note\">{date} · {scenes} scene{}</p></header>\n<main>{}</main></body></html>\n",
        if scenes == 1 { "" } else { "s" },
        sections.concat()
    )
}

fn table(report: &Report) -> String {
    let mut out = String::from(
        "<div class=\"wide\"><table class=\"figures\"><thead><tr><th>reconstructions</th><th class=\"n\">scenes</th>",
    );
    for (_, heading, unit) in COLUMNS {
        let _ = write!(out, "<th class=\"n\">{heading}<br>({unit})</th>");
    }
    out.push_str("<th class=\"n paper\">PlatoNeRF,<br>L1 (m)</th><th class=\"n\">size</th></tr></thead><tbody>");
    for group in &report.groups {
        let _ = write!(
            out,
            "<tr><th scope=\"row\">{}<small>{}</small></th><td class=\"n\">{}</td>",
            Safe(name(group)),
            Safe(describe_group(group)),
            thousands(group.scenes as u64)
        );
        for (figure, _, _) in COLUMNS {
            let main = if figure == "l1_m" { " main" } else { "" };
            let said = group.figures.get(figure).map_or("–".into(), |s| said(*s));
            let _ = write!(out, "<td class=\"n{main}\">{said}</td>");
        }
        let paper = match group.as_published {
            true => format!("{:.4}", report.published[0].l1_m),
            false => "–".to_owned(),
        };
        let _ = write!(
            out,
            "<td class=\"n paper\">{paper}</td><td class=\"n\">{}<small>{} a scene</small></td></tr>",
            bytes(group.bytes),
            bytes(group.bytes / group.scenes.max(1) as u64)
        );
    }
    let _ = write!(out, "</tbody></table></div>");
    for group in &report.groups {
        if let Some(verdict) = &group.verdict {
            let class = if verdict.doubtful { "warn" } else { "note" };
            let (name, text) = (Safe(name(group)), Safe(&verdict.text));
            let _ = write!(out, "<p class=\"{class}\">{name}: {text}</p>");
        }
    }
    let _ = write!(out, "<p class=\"note\">{CLASSES}</p>");
    out
}

/// Returns the last part of the group's location, as a short name.
fn name(group: &Group) -> &str {
    let place = group.place.trim_end_matches('/');
    place.rsplit('/').next().unwrap_or(place)
}

/// Formats the settings that distinguish groups, in one line.
fn describe_group(group: &Group) -> String {
    let text = |way: &str| match group.settings.pointer(way) {
        Some(Value::String(text)) => text.clone(),
        Some(value) => value.to_string(),
        None => "?".into(),
    };
    let spots = match group.spots {
        Some([least, most]) if least == most => format!("{most} spots"),
        Some([least, most]) => format!("{least} to {most} spots"),
        None => "spots unknown".into(),
    };
    let image = group.image.map_or_else(
        || "images of several sizes".into(),
        |[w, h]| format!("{w}×{h} pixels"),
    );
    let planes = match group.settings.pointer("/grid/planes") {
        Some(Value::Bool(false)) => ", no planes",
        _ => "",
    };
    format!(
        "from {}, {spots}, {image}, {} nodes, shadows {}{planes}, {} views",
        text("/from"),
        text("/grid/nodes"),
        match &*text("/grid/shadows") {
            "optimise" => "optimised",
            "carve" => "carved",
            "ignore" => "ignored",
            other => other,
        },
        text("/views"),
    )
}

fn said(spread: Spread) -> String {
    let mean = digits(spread.mean, 3);
    match spread.standard_error {
        Some(error) => format!("{mean}<small>± {}</small>", digits(error, 2)),
        None => mean,
    }
}

fn published(report: &Report) -> String {
    let mut out = String::from(
        "<div class=\"wide\"><table><thead><tr><th>method</th><th>light</th><th class=\"n\">L1 (m)</th></tr></thead><tbody>",
    );
    for figure in &report.published {
        let _ = write!(
            out,
            "<tr class=\"paper\"><th scope=\"row\">{}</th><td>{}</td><td class=\"n\">{:.4}</td></tr>",
            figure.method, figure.light, figure.l1_m
        );
    }
    let _ = write!(
        out,
        "</tbody></table></div><p class=\"note\">{}</p>",
        Safe(report.differs)
    );
    out
}

fn extremes(report: &Report) -> String {
    let mut out = String::new();
    for group in &report.groups {
        let _ = write!(
            out,
            "<h3>{} <small>{}</small></h3>",
            Safe(name(group)),
            Safe(describe_group(group))
        );
        if group.extremes.is_empty() {
            out.push_str(
                "<p class=\"none\">No novel views: the stage had views = 0, or no view stands in the open.</p>",
            );
            continue;
        }
        out.push_str("<div class=\"rows\">");
        for extreme in &group.extremes {
            let said = format!(
                "{}: scene {}, L1 {} m",
                extreme.rank,
                extreme.scene,
                digits(extreme.l1_m, 3)
            );
            let picture = match extreme.picture.is_empty() {
                true => "<p class=\"none\">It has no picture.</p>".to_owned(),
                false => format!(
                    "<img style=\"width:100%\" src=\"{}\" alt=\"novel views of scene {}: true distance, reconstructed distance, \
                     error, surface\">",
                    data_url(&extreme.picture),
                    extreme.scene
                ),
            };
            let _ = write!(
                out,
                "<figure>{picture}<figcaption>{said}</figcaption></figure>"
            );
        }
        out.push_str("</div>");
    }
    out
}

fn settings(report: &Report) -> String {
    let mut out = String::new();
    for group in &report.groups {
        let settings = serde_json::to_string_pretty(&group.settings).expect("plain data");
        let _ = write!(
            out,
            "<details><summary>{} <small>{}</small></summary><pre>{}</pre></details>",
            Safe(&group.place),
            Safe(&group.code),
            Safe(settings)
        );
    }
    out
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use serde_json::json;

    use super::*;
    use crate::commands::dataset::reconstructions::report::{Extreme, PUBLISHED};

    fn group(place: &str, as_published: bool) -> Group {
        let figure = Spread {
            mean: 0.0334,
            standard_error: Some(0.0021),
            scenes: 4,
        };
        Group {
            place: place.into(),
            settings: json!({"from": "truth", "views": 24, "grid": {"nodes": 192, "planes": true, "shadows": "optimise"}}),
            code: "reconstruct-3".into(),
            scenes: 4,
            bytes: 40_000_000,
            spots: Some([16, 16]),
            image: Some([512, 512]),
            figures: BTreeMap::from([("l1_m", figure)]),
            verdict: None,
            as_published,
            extremes: vec![Extreme {
                rank: "best",
                scene: 3,
                l1_m: 0.031,
                picture: b"png".to_vec(),
            }],
        }
    }

    #[test]
    fn published_figures_stand_beside_their_own_settings_only_and_nothing_is_fetched() {
        let report = Report {
            title: "<rooms>".into(),
            date: "2026-11-23".into(),
            groups: vec![group("store/chairs", true), group("store/<others>", false)],
            published: PUBLISHED,
            differs: "they differ",
        };
        let page = html(&report);
        assert!(page.contains("<title>&lt;rooms&gt;</title>"), "{page}");
        assert!(page.contains("&lt;others&gt;") && !page.contains("<others>"));
        assert_eq!(page.matches("<td class=\"n paper\">0.0862</td>").count(), 1);
        assert_eq!(page.matches("<td class=\"n paper\">–</td>").count(), 1);
        for said in [
            "from truth, 16 spots, 512×512 pixels, 192 nodes, shadows optimised, 24 views",
            "0.0334<small>± 0.0021</small>",
            "10.0 MB a scene",
            "best: scene 3, L1 0.0310 m",
            "0.3080",
        ] {
            assert!(page.contains(said), "{said}: {page}");
        }
        assert!(!page.contains("http"), "{page}");
    }
}
