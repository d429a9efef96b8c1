//! One job: stages, tasks, failures, explanation, log and job file.

mod curves;

use maud::{Markup, html};
use picofarm_proto::{
    ids::JobId,
    messages::{JobState, JobStatus},
    spec::{JobSpec, kinds::Manifest},
};

use super::{
    Page, events, grid,
    parts::{badge, bar, count, job_state, now_ms, remaining, safe, seconds, stage_state, time},
};
use crate::{
    App, Events,
    answer::Problem,
    history::{self, History},
    query::{Query, encode},
};

/// Number of running tasks in the list.
const RUNNING: usize = 24;
/// Number of events of the log.
const LOG: u32 = 200;
/// Number of events in which lines of trainings are looked for, the most that a coordinator gives.
const LINES: u32 = 1000;
/// Kinds of stages that make data sets.
const KINDS: [&str; 3] = ["render", "reprocess", "import"];
/// Number of groups of failures.
const GROUPS: usize = 20;

/// Returns the page of a job.
pub async fn page(app: &App, id: JobId, query: &Query) -> Result<Page, Problem> {
    let view = query.text("view");
    let explained = app.farm.explain(id, None).await?;
    let (job, reasons) = (explained.job, explained.reasons);
    let part = match view {
        "" => overview(app, &job, &*history::read(app, id).await?),
        "log" => {
            let newest = Events {
                job: Some(id),
                limit: LOG,
                newest: true,
                logs: true,
                ..Events::default()
            };
            let mut shown = app.farm.events(newest).await?;
            shown.reverse();
            html! { section #log { h2 { "Log" } (events::table(&shown, false)) } }
        }
        "curves" => {
            let newest = Events {
                job: Some(id),
                limit: LINES,
                newest: true,
                logs: true,
                ..Events::default()
            };
            curves::draw(&job, &app.farm.events(newest).await?)
        }
        "file" => file(&app.farm.spec(id).await?)?,
        other => {
            return Err(Problem::input(format!(
                "view: expected log, curves or file, found {other:?}"
            )));
        }
    };
    let views = [
        ("tasks", ""),
        ("curves", "curves"),
        ("log", "log"),
        ("job file", "file"),
    ];
    let views = views
        .into_iter()
        .filter(|(name, _)| *name != "curves" || curves::has_some(&job));
    let content = html! {
        section #head {
            h1 { (safe(&job.name)) " " (badge(job_state(job.state, job.paused, &job.tasks))) }
            (summary(&job))
            @if job.state == JobState::Active && !reasons.is_empty() {
                ul.reasons aria-label="Why it stands so" {
                    @for reason in &reasons { li { (safe(&reason.words)) } }
                }
            }
        }
        @if explained.may_change {
            section #actions.actions aria-label="Actions" { (actions(app, &job)) }
        } @else if job.state == JobState::Active || job.tasks.dead > 0 {
            p #actions.hint { "Your token has no right to change this job." }
        }
        nav.filters aria-label="Views" {
            @for (name, value) in views {
                a href={ "/jobs/" (id) "?" (encode(&[("view", value)])) }
                    aria-current=[(value == view).then_some("true")] { (name) }
            }
        }
        (part)
    };
    Ok(Page {
        title: job.name.clone(),
        tab: "/jobs",
        live: view != "file",
        script: view.is_empty().then_some("grid.js"),
        content,
    })
}

fn summary(job: &JobStatus) -> Markup {
    let end = job.ended_at_ms.unwrap_or_else(now_ms);
    let left = remaining(&job.tasks, job.mean_task_seconds, job.running.len());
    html! {
        (bar(&job.tasks))
        dl.line {
            div { dt { "tasks" } dd { (count(&job.tasks)) } }
            div { dt { "reused" } dd { (job.tasks.reused) } }
            div { dt { "dead" } dd { (job.tasks.dead) } }
            div { dt { "took" } dd { (seconds((end - job.submitted_at_ms) as f64 / 1000.0)) } }
            @if let Some(left) = left { div { dt { "left" } dd { "about " (seconds(left)) } } }
            @if let Some(mean) = job.mean_task_seconds { div { dt { "per task" } dd { (seconds(mean)) } } }
            @if job.workers > 0 { div { dt { "workers" } dd { (job.workers) } } }
            @if !job.user.is_empty() { div { dt { "user" } dd { (safe(&job.user)) } } }
            div { dt { "submitted" } dd { (time(job.submitted_at_ms)) } }
            div { dt { "id" } dd { code { (job.id) } } }
        }
        @if job.unverified > 0 && job.state == JobState::Active {
            p.hint { (job.unverified) " results were reported and not found in their store yet." }
        }
    }
}

/// The forms that change a job. The coordinator checks the rights again.
fn actions(app: &App, job: &JobStatus) -> Markup {
    let form = |act: &str, text: &str| {
        html! {
            form method="post" action={ "/jobs/" (job.id) "/" (act) } {
                input type="hidden" name="form" value=(app.guard.form());
                button id={ "act-" (act) } { (text) }
            }
        }
    };
    html! {
        @if job.state == JobState::Active {
            @if job.paused { (form("resume", "Resume")) } @else { (form("pause", "Pause")) }
            details.confirm {
                summary { "Cancel…" }
                p { "Running tasks are stopped. What is done stays, and is reused when the job is submitted again." }
                (form("cancel", "Cancel this job"))
            }
        }
        @if job.tasks.dead > 0 { (form("retry", "Retry dead tasks")) }
    }
}

fn overview(app: &App, job: &JobStatus, history: &History) -> Markup {
    html! {
        section #stages {
            h2 { "Stages" }
            div.scroll tabindex="0" role="region" aria-label="Table of stages" { table {
                thead { tr {
                    th { "stage" } th { "kind" } th { "state" } th.wide { "progress" } th.number { "tasks" }
                    th.number { "reused" } th.number { "dead" } th { "needs" } th { "result" }
                } }
                tbody { @for (position, stage) in job.stages.iter().enumerate() { tr {
                    td { (safe(&stage.name)) }
                    td { (safe(&stage.kind)) }
                    td { (badge(stage_state(job, stage))) }
                    td.wide { (bar(&stage.tasks)) }
                    td.number { (count(&stage.tasks)) }
                    td.number { (stage.tasks.reused) }
                    td.number { (stage.tasks.dead) }
                    td { (safe(stage.needs.join(", "))) }
                    td { (result(app, job, position)) }
                } } }
            } }
        }
        section #grid {
            h2 { "Tasks" }
            (grid::legend(job, history))
            @for (position, stage) in job.stages.iter().enumerate() {
                (grid::draw(job, position as u32, stage, history))
            }
        }
        @if !job.running.is_empty() {
            section #running {
                h2 { "Running" }
                div.scroll tabindex="0" role="region" aria-label="Table of running tasks" { table {
                    thead { tr {
                        th { "stage" } th.number { "task" } th { "worker" } th.number { "done" }
                        th.number { "since" } th { "at" }
                    } }
                    tbody { @for task in job.running.iter().take(RUNNING) {
                        @let name = job.stages.get(task.stage as usize).map_or("", |s| &*s.name);
                        tr {
                            td { (safe(name)) }
                            td.number { a href={ "/jobs/" (job.id) "/tasks/" (task.stage) "/" (task.index) } { (task.index) } }
                            td { (safe(&task.worker)) }
                            td.number { (format!("{:.0} %", 100.0 * task.fraction)) }
                            td.number { (seconds(task.seconds)) }
                            td { (safe(&task.text)) }
                        }
                    } }
                } }
                @if job.running.len() > RUNNING { p { (job.running.len() - RUNNING) " more run." } }
            }
        }
        (failures(job, history))
    }
}

/// A link to the scenes that a stage makes, if they are in a store that is shown.
fn result(app: &App, job: &JobStatus, position: usize) -> Markup {
    let stage = job.spec.stages.get(position);
    let results = stage.map(|stage| stage.task.results());
    // Predictions and reconstructions have manifests of the same form, and are no data sets.
    let kind = job.stages.get(position).map_or("", |stage| &*stage.kind);
    let dataset = results.and_then(|results| match results.manifest {
        Manifest::Scene { dataset } if KINDS.contains(&kind) => Some((results.store, dataset)),
        _ => None,
    });
    html! { @if let Some((store, dataset)) = dataset {
        @match app.stores.locate(store, dataset) {
            Some(set) => { a href={ "/data?" (encode(&[("set", &set)])) } { (safe(dataset)) } }
            None => { (safe(dataset)) }
        }
    } }
}

/// Failures with equal messages are one group: numbers in messages often differ.
fn failures(job: &JobStatus, history: &History) -> Markup {
    let groups = history.failures();
    html! {
        @if !groups.is_empty() {
            section #failures {
                h2 { "Failures by message" }
                ul.failures { @for group in groups.iter().take(GROUPS) {
                    @let last = &group.last;
                    li {
                        b { (group.count) "×" } " "
                        span.message { (safe(&last.message)) }
                        " " @if let Some(task) = last.task {
                            a href={ "/jobs/" (job.id) "/tasks/" (last.stage.unwrap_or(0)) "/" (task) } { "task " (task) }
                        }
                        @if !last.worker.is_empty() { " on " (safe(&last.worker)) }
                        ", " (time(last.at_ms))
                    }
                } }
                @if groups.len() > GROUPS { p { (groups.len() - GROUPS) " more messages." } }
            }
        }
    }
}

fn file(spec: &JobSpec) -> Result<Markup, Problem> {
    let text = toml::to_string_pretty(spec).map_err(|e| {
        let status = http::StatusCode::INTERNAL_SERVER_ERROR;
        Problem::new(status, format!("the job cannot be written as TOML: {e}"))
    })?;
    Ok(html! {
        section #file {
            h2 { "Job file" }
            p { "As submitted, with all defaults, versions and locations filled in." }
            pre.file tabindex="0" { (safe(text)) }
        }
    })
}
