//! The workers.

use maud::{Markup, html};
use picofarm_figures::number::thousands;
use picofarm_proto::messages::ConnectedWorker;

use super::{
    Page,
    parts::{badge, now_ms, safe, seconds},
};
use crate::{
    App,
    answer::Problem,
    query::{Query, encode},
};

/// Workers on a page.
const SHOWN: usize = 200;

/// Returns the list of workers.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let mut workers = app.farm.workers().await?;
    let all = workers.workers.len();
    let (state, find) = (query.text("state"), query.text("find"));
    let start = query.number("start")?.unwrap_or(0) as usize;
    let states = ["", "working", "idle", "on probation"];
    if !states.contains(&state) {
        return Err(Problem::input(format!(
            "state: expected working, idle or on probation, found {state:?}"
        )));
    }
    workers.workers.retain(|worker| {
        (state.is_empty() || self::state(worker).0 == state)
            && (worker.name.contains(find) || worker.id.starts_with(find))
    });
    let found = workers.workers.len();
    let link = |state: &str, start: usize| {
        let start = if start == 0 {
            String::new()
        } else {
            start.to_string()
        };
        let rest = encode(&[("state", state), ("find", find), ("start", &start)]);
        format!("/workers?{rest}")
    };
    let from = start.min(found);
    let to = (from + SHOWN).min(found);
    let content = html! {
        h1 { "Workers" }
        nav.filters aria-label="State" { @for name in states {
            a href=(link(name, 0)) aria-current=[(name == state).then_some("true")] {
                (if name.is_empty() { "all" } else { name })
            }
        } }
        form.search action="/workers" role="search" {
            @if !state.is_empty() { input type="hidden" name="state" value=(state); }
            label { "name or id " input name="find" value=(find) size="18"; }
            button { "Find" }
        }
        section #workers {
            p { (thousands(all as u64)) " connected to coordinator " b { (safe(&workers.coordinator)) } "."
                @if workers.elsewhere > 0 {
                    " " (workers.elsewhere) " more are connected to other coordinators of its catalog."
                }
            }
            @if all > 0 && found == 0 { p.none { "No worker is as selected." } }
            @else { (table(workers.workers[from..to].iter())) }
            nav.pages aria-label="Pages" {
                @if from > 0 { a href=(link(state, from.saturating_sub(SHOWN))) { "Previous" } }
                @if to < found { a href=(link(state, to)) { "Next" } }
            }
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

/// The state of a worker in a word, with its class.
fn state(worker: &ConnectedWorker) -> (&'static str, &'static str) {
    match (worker.quarantined, worker.leases) {
        (true, _) => ("on probation", "bad"),
        (false, 0) => ("idle", "off"),
        (false, _) => ("working", "run"),
    }
}

/// Returns a table of some of the workers, and a link to all: first those with a note.
pub fn few(workers: &[ConnectedWorker], most: usize) -> Markup {
    let noted = |w: &&ConnectedWorker| w.quarantined || !w.note.is_empty();
    let plain = workers.iter().filter(|worker| !noted(worker));
    let shown = workers.iter().filter(noted).chain(plain).take(most);
    html! {
        (table(shown))
        @if workers.len() > most { p { a href="/workers" { "All " (thousands(workers.len() as u64)) " workers" } } }
    }
}

/// Returns a table of workers.
fn table<'a>(workers: impl Iterator<Item = &'a ConnectedWorker>) -> Markup {
    let mut workers = workers.peekable();
    if workers.peek().is_none() {
        return html! { p.none { "No worker is connected. Start one with " code { "picofarm worker" } "." } };
    }
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
