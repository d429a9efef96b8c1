//! The history of all jobs.

use maud::{Markup, html};
use picofarm_proto::messages::{Event, EventKind};

use super::{
    Page,
    parts::{job_link, safe, time},
};
use crate::{
    App, Events,
    answer::Problem,
    query::{Query, encode},
};

/// Number of events on the page.
const SHOWN: u32 = 300;

/// Returns the page of the newest events.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let logs = query.text("logs") == "yes";
    let only = query.text("only");
    let events = app.farm.events(Events {
        limit: SHOWN,
        newest: true,
        logs,
        ..Events::default()
    });
    let mut events = events.await?;
    match only {
        "" => {}
        "problems" => events.retain(|event| is_problem(event.kind)),
        other => {
            let what = format!("only: expected problems, found {other:?}");
            return Err(Problem::input(what));
        }
    }
    events.reverse();
    let filters = [
        ("events", "", ""),
        ("with logs of tasks", "yes", ""),
        ("problems", "", "problems"),
    ];
    let content = html! {
        h1 { "Events" }
        nav.filters aria-label="Kinds" {
            @for (name, with, kinds) in filters {
                @let here = (with == "yes") == logs && kinds == only;
                a href={ "/events?" (encode(&[("logs", with), ("only", kinds)])) }
                    aria-current=[here.then_some("true")] { (name) }
            }
        }
        section #events { (table(&events, true)) }
    };
    Ok(Page {
        title: "Events".into(),
        tab: "/events",
        live: true,
        script: None,
        content,
    })
}

/// Whether somebody should look at it.
pub fn is_problem(kind: EventKind) -> bool {
    use EventKind as K;
    matches!(
        kind,
        K::Failed | K::Dead | K::Expired | K::Waiting | K::Alarm
    )
}

/// The name of a kind.
pub fn name(kind: EventKind) -> String {
    format!("{kind:?}").to_lowercase()
}

/// Returns a table of events. Those of one job need no column for it.
pub fn table(events: &[Event], of_all_jobs: bool) -> Markup {
    if events.is_empty() {
        return html! { p.none { "Nothing happened yet." } };
    }
    html! {
        div.scroll tabindex="0" role="region" aria-label="Table of events" { table.log {
            thead { tr {
                th { "time" } @if of_all_jobs { th { "job" } } th { "event" } th { "stage" } th { "task" }
                th { "worker" } th { "message" }
            } }
            tbody { @for event in events {
                tr.problem-row[is_problem(event.kind)] {
                    td { (time(event.at_ms)) }
                    @if of_all_jobs { td { (job_link(event.job)) } }
                    td { (name(event.kind)) }
                    td.number { @if let Some(stage) = event.stage { (stage) } }
                    td.number { (task(event)) }
                    td { (safe(&event.worker)) }
                    td.message { (safe(&event.message)) }
                }
            } }
        } }
    }
}

/// The task of an event, as a link, or its range of tasks.
fn task(event: &Event) -> Markup {
    html! {
        @match (event.task, event.lo, event.hi) {
            (Some(task), _, _) => {
                a href={ "/jobs/" (event.job) "/tasks/" (event.stage.unwrap_or(0)) "/" (task) } { (task) }
            }
            (None, Some(lo), Some(hi)) if hi > lo + 1 => { (lo) "–" (hi - 1) }
            (None, Some(lo), Some(_)) => { (lo) }
            _ => {}
        }
    }
}
