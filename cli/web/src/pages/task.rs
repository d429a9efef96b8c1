//! One task: where it stands, its attempts and its result.

use maud::html;
use picofarm_proto::ids::JobId;

use super::{
    Page, events,
    parts::{bytes, job_link, safe, seconds, time},
};
use crate::{App, answer::Problem};

/// Returns the page of a task, given by the position of its stage and its index.
pub async fn page(app: &App, job: JobId, stage: u32, task: u64) -> Result<Page, Problem> {
    let explained = app.farm.explain(job, Some((stage, task))).await?;
    let Some(found) = explained.task else {
        return Err(Problem::missing(format!(
            "stage {stage} has no task {task}"
        )));
    };
    let limits = [
        ("failures", found.failures, found.max_failures),
        ("crashes", found.crashes, found.max_crashes),
        (
            "interruptions",
            found.interruptions,
            found.max_interruptions,
        ),
    ];
    let content = html! {
        h1 { "Task " (task) " of stage " (stage) ", job " (job_link(job)) }
        section #task {
            dl.facts-list {
                dt { "state" } dd { (found.state.name()) }
                dt { "why" } dd { (safe(&found.words)) }
                @for (name, count, most) in limits {
                    dt { (name) } dd { (count) " of at most " (most) }
                }
                @if !found.last_error.is_empty() {
                    dt { "last error" } dd { pre { (safe(&found.last_error)) } }
                }
                @for rerun in &found.reruns { dt { "run again" } dd { (safe(rerun)) } }
            }
        }
        @if let Some(output) = &found.output {
            section #result {
                h2 { "Result" }
                dl.facts-list {
                    dt { "manifest" } dd { code { "SHA-256 " (safe(&output.manifest_sha256)) } }
                    dt { "size" } dd { (bytes(output.bytes)) }
                    dt { "took" } dd { (seconds(output.seconds)) }
                    dt { "origin" } dd {
                        (if output.adopted { "found in the store" } else { "computed" })
                        @if let Some(made) = &output.made {
                            " by " (safe(&made.worker)) " for job " (job_link(made.job)) " "
                            (safe(&made.job_name)) ", " (time(made.at_ms))
                        }
                    }
                }
            }
        }
        section #attempts { h2 { "History" } (events::table(&found.events, false)) }
    };
    Ok(Page {
        title: format!("Task {task}"),
        tab: "/jobs",
        live: true,
        script: None,
        content,
    })
}
