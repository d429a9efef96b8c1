//! The report's page.

use picofarm_figures::STYLE;

use super::{Report, curves, made, maps, summary::summary, table, text::Safe, trade};

/// Returns the report as one self-contained HTML page, without scripts, other files or network
/// access.
pub fn html(report: &Report) -> String {
    let summary = summary(report);
    let sections = [
        ("figures", "Figures", table::tables(report, &summary)),
        ("curves", "Curves", curves::curves(report, &summary)),
        ("examples", "Examples", maps::maps(report)),
        (
            "speed",
            "Speed against error",
            trade::speed(report, &summary),
        ),
        (
            "scale",
            "Error against number of scenes",
            trade::scale(&summary),
        ),
        ("made", "What it was made of", made::made(report)),
    ];
    let links = sections
        .iter()
        .map(|(id, name, _)| format!("<a href=\"#{id}\">{name}</a>"));
    let links: String = links.collect();
    let bodies = sections
        .iter()
        .map(|(id, name, body)| format!("<section id=\"{id}\"><h2>{name}</h2>{body}</section>\n"));
    let bodies: String = bodies.collect();
    let title = Safe(&report.title);
    let date = match &*report.date {
        "" => String::new(),
        date => format!("{} · ", Safe(date)),
    };
    let models = report.models.len();
    let experiments = summary.groups.len();
    let plural = |n: usize| if n == 1 { "" } else { "s" };
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>{title}</title>\n<style>{STYLE}</style></head>\n<body>\
         <header><h1>{title}</h1><p class=\"note\">{date}{models} model{}, {experiments} experiment{}</p>\
         <nav>{links}</nav></header>\n<main>{bodies}</main></body></html>\n",
        plural(models),
        plural(experiments)
    )
}
