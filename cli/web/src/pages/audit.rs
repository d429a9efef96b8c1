//! The audit log, for administrators.

use maud::html;

use super::{
    Page,
    parts::{job_link, safe, time},
};
use crate::{App, answer::Problem, query::Query};

/// Number of entries on a page.
const SHOWN: u32 = 200;

/// Returns the page of the audit log.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let before = query.number("before")?;
    let entries = app.farm.audit(before, SHOWN).await?;
    let older = entries.last().filter(|_| entries.len() == SHOWN as usize);
    let content = html! {
        h1 { "Audit" }
        section #audit {
            @if entries.is_empty() { p.none { "No entries." } }
            @else {
                div.scroll tabindex="0" role="region" aria-label="Table of acts" { table.log {
                    thead { tr { th { "time" } th { "who" } th { "act" } th { "job" } th { "outcome" } th { "detail" } } }
                    tbody { @for entry in &entries { tr {
                        td { (time(entry.at_ms)) }
                        td { (safe(&entry.who)) }
                        td { (entry.act.name()) }
                        td { @if let Some(job) = entry.job { (job_link(job)) } }
                        td { (entry.outcome.name()) }
                        td.message { (safe(&entry.detail)) }
                    } } }
                } }
                @if let Some(last) = older {
                    p { a href={ "/audit?before=" (last.sequence) } { "Older entries" } }
                }
            }
        }
    };
    Ok(Page {
        title: "Audit".into(),
        tab: "/audit",
        live: before.is_none(),
        script: None,
        content,
    })
}
