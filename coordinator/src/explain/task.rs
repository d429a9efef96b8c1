//! Explains the state of one task.

use picofarm_catalog::RangeState;
use picofarm_proto::messages::{Event, EventKind, Made, TaskExplanation, TaskOutput, TaskState};

use super::facts::TaskFacts;
use crate::core::span;

/// Explains the state of a task and its reason.
pub fn task(facts: TaskFacts) -> TaskExplanation {
    let (failures, crashes, interruptions, last_error) = facts
        .record
        .exception
        .as_ref()
        .map(|e| (e.failures, e.crashes, e.interruptions, e.last_error.clone()))
        .unwrap_or_default();
    let state = match (&facts.record.range, &facts.record.output) {
        (Some(range), output) => match &range.state {
            RangeState::Pending { .. } => TaskState::Pending,
            RangeState::Leased(_) if output.is_some() => TaskState::Done,
            RangeState::Leased(_) => TaskState::Leased,
            RangeState::Done { .. } => TaskState::Done,
            RangeState::Dead => TaskState::Dead,
        },
        (None, Some(_)) => TaskState::Done,
        (None, None) => TaskState::Gone,
    };
    let output = output(&facts);
    let words = match state {
        TaskState::Pending => pending(&facts, &last_error),
        TaskState::Leased => leased(&facts),
        TaskState::Done => done(&facts, output.as_ref()),
        TaskState::Dead => format!(
            "given up after {failures} of {} failures, {crashes} of {} lost workers and {interruptions} of {} interruptions: \
             {last_error}; correct the cause, then `picofarm job retry {}`",
            facts.limits.max_failures,
            facts.limits.max_crashes,
            facts.limits.max_interruptions,
            facts.job
        ),
        TaskState::Gone => "its job was stopped before it ran".to_owned(),
    };
    TaskExplanation {
        index: facts.index,
        state,
        words,
        failures,
        max_failures: facts.limits.max_failures,
        crashes,
        max_crashes: facts.limits.max_crashes,
        interruptions,
        max_interruptions: facts.limits.max_interruptions,
        last_error,
        reruns: reruns(&facts.events),
        output,
        events: facts.events,
    }
}

fn pending(facts: &TaskFacts, last_error: &str) -> String {
    match facts.record.range.as_ref().map(|r| &r.state) {
        Some(RangeState::Pending { not_before_ms }) if *not_before_ms > facts.now_ms => format!(
            "waits after a failure for another {} before the next attempt: {last_error}",
            span(not_before_ms - facts.now_ms)
        ),
        _ => "waits for a worker".to_owned(),
    }
}

fn leased(facts: &TaskFacts) -> String {
    if let Some(running) = &facts.running {
        let at = match &*running.text {
            "" => String::new(),
            text => format!(" ({text})"),
        };
        return format!(
            "runs on {} for {}: {:.0} % done{at}",
            running.worker,
            span(facts.now_ms - running.since_ms),
            f64::from(running.fraction) * 100.0
        );
    }
    let granted = facts
        .events
        .iter()
        .rev()
        .find(|e| e.kind == EventKind::Leased);
    match granted {
        Some(event) => format!(
            "leased to {} for {}, which has not reported on it yet: it works on others of the same lease, or has only begun",
            event.worker,
            span(facts.now_ms - event.at_ms)
        ),
        None => "leased to a worker".to_owned(),
    }
}

fn done(facts: &TaskFacts, output: Option<&TaskOutput>) -> String {
    let Some(output) = output else {
        return "done".to_owned();
    };
    let how = if output.adopted {
        "found in the store"
    } else {
        "computed"
    };
    match &output.made {
        Some(made) if made.job == facts.job => {
            format!("done: {how} by {} under this job", made.worker)
        }
        Some(made) => format!(
            "reused: {how} by {} under job {} ({})",
            made.worker, made.job, made.job_name
        ),
        None => format!("done: {how}; the history does not tell by whom"),
    }
}

fn output(facts: &TaskFacts) -> Option<TaskOutput> {
    let output = facts.record.output.as_ref()?;
    let here = facts
        .events
        .iter()
        .find(|e| committed(e))
        .map(|e| (facts.job, String::new(), e));
    let there = facts
        .elsewhere
        .as_ref()
        .map(|(job, name, e)| (*job, name.clone(), e));
    Some(TaskOutput {
        manifest_sha256: hex::encode(output.manifest),
        bytes: output.bytes,
        seconds: output.seconds,
        adopted: output.adopted,
        made: here.or(there).map(|(job, job_name, event)| Made {
            worker: event.worker.clone(),
            job,
            job_name,
            at_ms: event.at_ms,
        }),
    })
}

/// Returns whether a history line records a worker's reported result.
pub fn committed(event: &Event) -> bool {
    match event.kind {
        EventKind::Committed => true,
        EventKind::Reused => !event.worker.is_empty(),
        _ => false,
    }
}

/// Returns why a task ran more than once: the reason why each lease but the last ended.
fn reruns(events: &[Event]) -> Vec<String> {
    let mut reruns = Vec::new();
    let mut why: Option<String> = None;
    let mut leased = false;
    for event in events {
        let ended = match event.kind {
            EventKind::Leased => {
                if leased {
                    reruns.push(why.take().unwrap_or_else(|| {
                        "the lease before did not reach its worker, or was handed back".to_owned()
                    }));
                }
                leased = true;
                why = None;
                continue;
            }
            // A loss is recorded twice, for the lease and for the running task. The first record
            // suffices.
            _ if why.is_some() => continue,
            EventKind::Expired => event.message.clone(),
            EventKind::Released => format!("{} gave it back: {}", event.worker, event.message),
            EventKind::Failed => format!("it failed on {}: {}", event.worker, event.message),
            EventKind::Dead => format!(
                "it was given up on {}: {}, and then tried again",
                event.worker, event.message
            ),
            EventKind::Retried => "its job was retried".to_owned(),
            _ => continue,
        };
        why = Some(ended);
    }
    reruns
}
