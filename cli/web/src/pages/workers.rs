//! The workers.

use maud::{Markup, html};
use picofarm_proto::messages::ConnectedWorker;

use super::{
    Page,
    parts::{badge, now_ms, safe, seconds},
};
use crate::{App, answer::Problem};

/// Returns the list of workers.
pub async fn page(app: &App) -> Result<Page, Problem> {
    let workers = app.farm.workers().await?;
    let content = html! {
        h1 { "Workers" }
        section #workers {
            p { "Connected to coordinator " b { (safe(&workers.coordinator)) } "."
                @if workers.elsewhere > 0 {
                    " " (workers.elsewhere) " more are connected to other coordinators of its catalog."
                }
            }
            (table(&workers.workers))
        }
    };
    Ok(Page {
        title: "Workers".into(),
        tab: "/workers",
        live: true,
        script: None,
        content,
    })
}

/// Returns the table of workers.
pub fn table(workers: &[ConnectedWorker]) -> Markup {
    if workers.is_empty() {
        return html! { p.none { "No worker is connected. Start one with " code { "picofarm worker" } "." } };
    }
    let state = |w: &ConnectedWorker| match (w.quarantined, w.leases) {
        (true, _) => ("on probation", "bad"),
        (false, 0) => ("idle", "off"),
        (false, _) => ("working", "run"),
    };
    html! {
        div.scroll tabindex="0" role="region" aria-label="Table of workers" { table {
            thead { tr {
                th { "worker" } th { "state" } th.number { "cores" } th.number { "leases" }
                th.number { "tasks" } th.number { "connected" } th { "version" } th { "note" }
            } }
            tbody { @for w in workers {
                tr {
                    td title=(w.id) { (safe(&w.name)) }
                    td { (badge(state(w))) }
                    td.number { (w.cores) }
                    td.number { (w.leases) }
                    td.number { (w.tasks) }
                    td.number { (seconds((now_ms() - w.since_ms) as f64 / 1000.0)) }
                    td { (safe(&w.version)) }
                    td {
                        @if w.quarantined && w.note.is_empty() { "its range crashed other workers" }
                        (safe(&w.note))
                    }
                }
            } }
        } }
    }
}
