//! The farm at a glance, and the list of jobs.

use futures::future::join_all;
use maud::{Markup, html};
use picofarm_figures::number::thousands;
use picofarm_proto::messages::{Event, EventKind, JobState, JobSummary};

use super::{
    Page,
    parts::{badge, bar, count, job_link, job_state, now_ms, safe, seconds, time},
};
use crate::{
    App, Events, JobFilter,
    answer::Problem,
    query::{Query, encode},
};

/// Number of jobs on the first page.
const FEW: u32 = 12;
/// Number of jobs on a page of the list.
const MANY: u32 = 50;
/// Number of workers on the first page.
const WORKERS: usize = 20;
/// Number of waiting jobs that are explained.
const EXPLAINED: usize = 4;
/// Bars of the chart of the last hour.
const SLOTS: usize = 30;
const HOUR_MS: i64 = 3_600_000;

/// Returns the first page.
pub async fn farm(app: &App) -> Result<Page, Problem> {
    let few = JobFilter {
        limit: FEW,
        ..JobFilter::default()
    };
    let newest = Events {
        limit: 1000,
        newest: true,
        ..Events::default()
    };
    let (jobs, workers, events) = tokio::join!(
        app.farm.jobs(&few),
        app.farm.workers(),
        app.farm.events(newest)
    );
    let ((jobs, _), workers, events) = (jobs?, workers?, events?);
    let all = &workers.workers;
    let cores: u32 = all.iter().map(|w| w.cores).sum();
    let leased: u64 = jobs.iter().map(|job| job.tasks.leased).sum();
    let waiting = jobs.iter().filter(|job| {
        job.state == JobState::Active && job.tasks.leased == 0 && job.tasks.pending > 0
    });
    let reasons = join_all(waiting.take(EXPLAINED).map(async |job| {
        let explained = app.farm.explain(job.id, None).await?;
        Ok::<_, Problem>((job, explained.reasons))
    }));
    let reasons = reasons.await.into_iter().collect::<Result<Vec<_>, _>>()?;
    let hour = Hour::of(&events, now_ms());
    let content = html! {
        h1.visually-hidden { "Farm" }
        section #facts.facts aria-label="Summary" {
            (fact("workers", &(all.len() as u64 + u64::from(workers.elsewhere)).to_string()))
            (fact("cores", &cores.to_string()))
            (fact("tasks leased", &thousands(leased)))
            (fact(&format!("tasks done, {}", hour.span()), &hour.done_text()))
            figure.hour {
                figcaption { "tasks done per 2 minutes, last hour" }
                (hour.chart())
            }
        }
        @if !reasons.is_empty() {
            section #waiting {
                h2 { "Waiting" }
                ul.reasons {
                    @for (job, reasons) in &reasons {
                        @for reason in reasons {
                            li { (job_link(job.id)) " " (safe(&job.name)) ": " (safe(&reason.words)) }
                        }
                    }
                }
            }
        }
        section #jobs { h2 { "Jobs" } (table(&jobs)) p { a href="/jobs" { "All jobs" } } }
        section #workers {
            h2 { "Workers" }
            (super::workers::few(all, WORKERS))
        }
    };
    Ok(Page {
        title: "Farm".into(),
        tab: "/",
        live: true,
        script: None,
        content,
    })
}

/// Returns the list of jobs.
pub async fn jobs(app: &App, query: &Query) -> Result<Page, Problem> {
    const STATES: [(&str, Option<JobState>); 5] = [
        ("", None),
        ("active", Some(JobState::Active)),
        ("done", Some(JobState::Done)),
        ("failed", Some(JobState::Failed)),
        ("cancelled", Some(JobState::Cancelled)),
    ];
    let asked = query.text("state");
    let state = STATES.iter().find(|(name, _)| *name == asked);
    let Some((_, state)) = state else {
        return Err(Problem::input(format!(
            "state: expected active, done, failed or cancelled, found {asked:?}"
        )));
    };
    let filter = JobFilter {
        state: *state,
        user: query.text("user").into(),
        find: query.text("find").into(),
        page: query.text("page").into(),
        limit: MANY,
    };
    let (jobs, next) = app.farm.jobs(&filter).await?;
    let link = |state: &str, page: &str| {
        let rest = encode(&[
            ("state", state),
            ("user", &filter.user),
            ("find", &filter.find),
            ("page", page),
        ]);
        format!("/jobs?{rest}")
    };
    let content = html! {
        h1 { "Jobs" }
        nav.filters aria-label="State" {
            @for (name, _) in STATES {
                a href=(link(name, "")) aria-current=[(name == asked).then_some("true")] {
                    (if name.is_empty() { "all" } else { name })
                }
            }
        }
        form.search action="/jobs" role="search" {
            @if !asked.is_empty() { input type="hidden" name="state" value=(asked); }
            label { "name or id " input name="find" value=(filter.find) size="18"; }
            label { "user " input name="user" value=(filter.user) size="12"; }
            button { "Find" }
        }
        section #jobs {
            (table(&jobs))
            @if let Some(next) = next { p { a href=(link(asked, &next)) { "Older jobs" } } }
        }
    };
    Ok(Page {
        title: "Jobs".into(),
        tab: "/jobs",
        live: true,
        script: None,
        content,
    })
}

fn fact(name: &str, value: &str) -> Markup {
    html! { div.fact { b { (value) } span { (name) } } }
}

fn table(jobs: &[JobSummary]) -> Markup {
    if jobs.is_empty() {
        return html! { p.none { "No jobs. Submit one with " code { "picofarm job submit FILE" } "." } };
    }
    html! {
        div.scroll tabindex="0" role="region" aria-label="Table of jobs" { table {
            thead { tr {
                th { "job" } th { "name" } th { "user" } th { "state" } th.wide { "progress" }
                th.number { "tasks" } th { "submitted" } th.number { "took" }
            } }
            tbody { @for job in jobs {
                @let took = job.ended_at_ms.unwrap_or_else(now_ms) - job.submitted_at_ms;
                tr {
                    td { (job_link(job.id)) }
                    td.name { a href={ "/jobs/" (job.id) } { (safe(&job.name)) } }
                    td { (safe(&job.user)) @if !job.project.is_empty() { " / " (safe(&job.project)) } }
                    td { (badge(job_state(job.state, job.paused, &job.tasks))) }
                    td.wide { (bar(&job.tasks)) }
                    td.number { (count(&job.tasks)) }
                    td { (time(job.submitted_at_ms)) }
                    td.number { (seconds(took as f64 / 1000.0)) }
                }
            } }
        } }
    }
}

/// Finished tasks of the last hour.
struct Hour {
    slots: [u64; SLOTS],
    /// The newest events do not reach back an hour.
    cut_off_s: Option<f64>,
}

impl Hour {
    fn of(events: &[Event], now_ms: i64) -> Self {
        let mut slots = [0; SLOTS];
        let from = now_ms - HOUR_MS;
        for event in events.iter().filter(|e| e.kind == EventKind::Committed) {
            let slot = (event.at_ms - from).div_euclid(HOUR_MS / SLOTS as i64);
            if let Some(slot) = usize::try_from(slot).ok().and_then(|s| slots.get_mut(s)) {
                *slot += tasks(event);
            }
        }
        let first = events.first().filter(|_| events.len() >= 1000);
        let cut = first.filter(|first| first.at_ms > from);
        Self {
            slots,
            cut_off_s: cut.map(|first| (now_ms - first.at_ms) as f64 / 1000.0),
        }
    }

    fn span(&self) -> String {
        match self.cut_off_s {
            Some(s) => format!("last {}", seconds(s)),
            None => "last hour".into(),
        }
    }

    fn done_text(&self) -> String {
        thousands(self.slots.iter().sum())
    }

    fn chart(&self) -> Markup {
        let most = self.slots.iter().copied().max().unwrap_or(0);
        let label = format!("at most {most} tasks in 2 minutes");
        html! {
            svg.chart viewBox="0 0 120 24" preserveAspectRatio="none" role="img" aria-label=(label) {
                @for (i, n) in self.slots.iter().enumerate() {
                    @let height = if *n == 0 { 0.0 } else { 1.0 + 22.0 * *n as f64 / most as f64 };
                    rect x=(4 * i) width="3" y=(format!("{:.2}", 24.0 - height))
                        height=(format!("{height:.2}")) {}
                }
            }
            span.most { (most) }
        }
    }
}

/// The number of tasks of an event.
fn tasks(event: &Event) -> u64 {
    match (event.lo, event.hi) {
        (Some(lo), Some(hi)) if hi > lo && event.task.is_none() => hi - lo,
        _ => 1,
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::ids::JobId;

    use super::*;

    #[test]
    fn the_last_hour_counts_finished_tasks_only_and_none_from_before() {
        let at = |at_ms, kind, hi| Event {
            sequence: 1,
            at_ms,
            job: "0190b5d8-0000-7000-8000-000000000000"
                .parse::<JobId>()
                .unwrap(),
            stage: Some(0),
            kind,
            task: None,
            lo: Some(0),
            hi: Some(hi),
            worker: String::new(),
            message: String::new(),
            seconds: 0.0,
        };
        let now = 10 * HOUR_MS;
        let hour = Hour::of(
            &[
                at(now - HOUR_MS - 1, EventKind::Committed, 7),
                at(now - HOUR_MS, EventKind::Committed, 2),
                at(now - 5, EventKind::Leased, 9),
                at(now - 1, EventKind::Committed, 3),
            ],
            now,
        );
        assert_eq!((hour.slots[0], hour.slots[SLOTS - 1]), (2, 3));
        assert_eq!(
            (hour.done_text(), hour.span()),
            ("5".into(), "last hour".into())
        );
    }
}
