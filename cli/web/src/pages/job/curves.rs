//! The learning curves of a job's trainings while they run, from the lines that they log: `epoch
//! 3/54: loss 0.12; validation MAE 0.3 m, RMSE 0.4 m`, or `IoU 0.9, MAE …` for masks. A training
//! logs at most 80 of them.

use std::collections::BTreeMap;

use maud::{Markup, html};
use picofarm_proto::messages::{Event, EventKind, JobStatus};

use super::super::{
    chart::{Series, lines},
    parts::{safe, scroll, seconds},
};

/// Most curves in the charts: of the tasks with the newest lines.
const CURVES: usize = 60;

/// A logged epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Epoch {
    epoch: f64,
    loss: f64,
    /// The mean absolute error in metres, or one minus IoU.
    validation: Option<f64>,
}

/// Returns whether a job has trainings.
pub fn has_some(job: &JobStatus) -> bool {
    job.stages.iter().any(|stage| stage.kind == "train")
}

/// Returns the curves of the trainings.
pub fn draw(job: &JobStatus, events: &[Event]) -> Markup {
    let mut curves: BTreeMap<(u32, u64), Vec<Epoch>> = BTreeMap::new();
    for event in events.iter().rev().filter(|e| e.kind == EventKind::Log) {
        let (Some(stage), Some(task)) = (event.stage, event.task) else {
            continue;
        };
        let trains = job
            .stages
            .get(stage as usize)
            .is_some_and(|s| s.kind == "train");
        if let Some(epoch) = parse(&event.message).filter(|_| trains)
            && (curves.len() < CURVES || curves.contains_key(&(stage, task)))
        {
            curves.entry((stage, task)).or_default().push(epoch);
        }
    }
    let series = |figure: &dyn Fn(&Epoch) -> Option<f64>| {
        let series = curves.iter().map(|((stage, task), epochs)| {
            let runs = job
                .running
                .iter()
                .any(|t| t.stage == *stage && t.index == *task);
            let mut points: Vec<(f64, f64)> = epochs
                .iter()
                .filter_map(|epoch| Some((epoch.epoch, figure(epoch)?)))
                .collect();
            // A task that runs again logs its epochs again; the newest line of each counts.
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            points.dedup_by(|later, first| later.0 == first.0);
            Series {
                label: format!("task {task} of {}", job.stages[*stage as usize].name),
                class: if runs { "open" } else { "finished" },
                points,
            }
        });
        series.collect::<Vec<_>>()
    };
    html! {
        section #validation {
            h2 { "Validation error by epoch" }
            (lines("Validation error of each training by epoch", ["epoch", "MAE in metres, or 1 − IoU"],
                &series(&|epoch| epoch.validation)))
        }
        section #loss {
            h2 { "Training loss by epoch" }
            (lines("Loss of each training by epoch", ["epoch", "loss"], &series(&|epoch| Some(epoch.loss))))
            p.legend { span.swatch.open { "running" } span.swatch.finished { "ended" } }
            p.hint { "From the newest " (events.len()) " events, of at most " (CURVES) " trainings." }
        }
        (running(job))
    }
}

/// The figures of the trainings that run.
fn running(job: &JobStatus) -> Markup {
    let trains = |stage: u32| job.stages.get(stage as usize).filter(|s| s.kind == "train");
    let rows = job
        .running
        .iter()
        .filter_map(|t| Some((trains(t.stage)?, t)));
    let rows: Vec<_> = rows.take(CURVES).collect();
    html! {
        @if !rows.is_empty() { section #now {
            h2 { "Now" }
            (scroll("Table of running trainings", html! { table {
                thead { tr { th { "stage" } th.number { "task" } th { "worker" } th.number { "since" } th { "at" } } }
                tbody { @for (stage, task) in rows { tr {
                    td { (safe(&stage.name)) }
                    td.number { a href={ "/jobs/" (job.id) "/tasks/" (task.stage) "/" (task.index) } { (task.index) } }
                    td { (safe(&task.worker)) }
                    td.number { (seconds(task.seconds)) }
                    td { (safe(&task.text)) }
                } } }
            } }))
        } }
    }
}

/// Reads a logged epoch; `None` for other lines.
fn parse(message: &str) -> Option<Epoch> {
    let (_, rest) = message.split_once("epoch ")?;
    let (epoch, rest) = rest.split_once('/')?;
    let (_, rest) = rest.split_once(": loss ")?;
    let (loss, validation) = match rest.split_once("; validation ") {
        Some((loss, validation)) => (loss, validation),
        None => (rest, ""),
    };
    let first = |text: &str| text.split([' ', ',']).next()?.parse::<f64>().ok();
    let iou = validation.strip_prefix("IoU ").and_then(first);
    let mae = validation.strip_prefix("MAE ").and_then(first);
    Some(Epoch {
        epoch: epoch.parse().ok()?,
        loss: first(loss)?,
        validation: mae.or(iou.map(|iou| 1.0 - iou)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_are_read_from_the_lines_that_trainings_log() {
        let epoch = |epoch, loss, validation| {
            Some(Epoch {
                epoch,
                loss,
                validation,
            })
        };
        for (line, expected) in [
            (
                "info: epoch 3/54: loss 0.1200; validation MAE 0.3000 m, RMSE 0.4000 m",
                epoch(3.0, 0.12, Some(0.3)),
            ),
            (
                "info: epoch 1/2: loss 0.5000; validation IoU 0.7500, MAE 0.1, F1 0.8",
                epoch(1.0, 0.5, Some(0.25)),
            ),
            ("info: epoch 9/9: loss 0.2000", epoch(9.0, 0.2, None)),
            ("info: goes on from the checkpoint after 12 steps", None),
            ("info: epoch x/9: loss 0.2", None),
        ] {
            assert_eq!(parse(line), expected, "{line}");
        }
    }
}
