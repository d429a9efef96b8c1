//! Why a job's tasks do not run, and what became of one task: in words, from facts that are passed in. Pure.

use picofarm_catalog::{Exception, Holdups, RangeState, TaskRecord};
use picofarm_proto::{
    ids::JobId,
    model::{
        Event, EventKind, JobState, Limits, Made, Reason, StageState, StageStatus, TaskCounts,
        TaskExplanation, TaskOutput, TaskState,
    },
};

/// A connected worker with regard to a job.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Its name.
    pub name: String,
    /// Whether it may run the job's tasks, or why not.
    pub may_run: Result<(), String>,
    /// It asks for work.
    pub idle: bool,
    /// It holds a range that crashed others, and gets nothing else.
    pub quarantined: bool,
}

/// How a task runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Runs {
    /// Its worker's name.
    pub worker: String,
    /// Share done in [0, 1].
    pub fraction: f32,
    /// What it is at, in its own words; empty = nothing to say.
    pub text: String,
    /// Unix time at which it was first heard of, milliseconds.
    pub since_ms: i64,
}

/// What decides whether a job's tasks run.
#[derive(Debug, Clone, PartialEq)]
pub struct JobFacts {
    /// The job.
    pub job: JobId,
    /// Where it stands.
    pub state: JobState,
    /// It is held by a person.
    pub paused: bool,
    /// Its stages.
    pub stages: Vec<StageStatus>,
    /// Its tasks.
    pub counts: TaskCounts,
    /// What its tasks wait for.
    pub holdups: Holdups,
    /// The workers connected to the coordinator that answers.
    pub candidates: Vec<Candidate>,
    /// Jobs that go first and have tasks waiting for the same workers.
    pub ahead: Vec<JobId>,
    /// Workers connected to other coordinators.
    pub elsewhere: u32,
    /// Unix time, milliseconds.
    pub now_ms: i64,
}

/// What is known of a task.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskFacts {
    /// Its index.
    pub index: u64,
    /// Its job.
    pub job: JobId,
    /// What the catalog holds.
    pub record: TaskRecord,
    /// Its history, oldest first.
    pub events: Vec<Event>,
    /// The job's budgets.
    pub limits: Limits,
    /// Who committed its result under another job: that job and its name, and the line of its history.
    pub elsewhere: Option<(JobId, String, Event)>,
    /// Where a worker has reported on it: how it runs.
    pub running: Option<Runs>,
    /// Unix time, milliseconds.
    pub now_ms: i64,
}

fn reason(code: &str, tasks: u64, words: String) -> Reason {
    Reason {
        code: code.into(),
        tasks,
        words,
        until_ms: None,
    }
}

/// "1 task", "3 tasks".
fn n(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// "12 s", "3 min".
fn span(ms: i64) -> String {
    let seconds = ms.max(0) as u64 / 1000;
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        _ => format!("{} h", seconds / 3600),
    }
}

/// Why a job's tasks do not run, most important first. Never empty.
pub fn job(facts: &JobFacts) -> Vec<Reason> {
    let (counts, id) = (&facts.counts, facts.job);
    let mut reasons = Vec::new();
    match facts.state {
        JobState::Done => {
            reasons.push(reason("ended", counts.total, "every task is done".into()));
        }
        JobState::Cancelled => {
            let left = counts.total - counts.done;
            let words = format!(
                "the job was cancelled with {} not done; submit it with --again to run them (what is done is reused)",
                n(left, "task")
            );
            reasons.push(reason("cancelled", left, words));
        }
        JobState::Failed => blocked(facts, &mut reasons),
        JobState::Active => {
            waiting(facts, &mut reasons);
            blocked(facts, &mut reasons);
            if counts.leased > 0 {
                let words = format!("{} under lease at workers now", n(counts.leased, "task"));
                reasons.push(reason("leased", counts.leased, words));
            }
            if reasons.is_empty() {
                let words = "nothing waits: the job is about to end".to_owned();
                reasons.push(reason("ending", 0, words));
            }
        }
    }
    if counts.dead > 0 {
        let last = last_error(facts.holdups.failed.iter().filter(|e| e.dead));
        let words = format!(
            "{} given up{last}; mend the cause, then `picofarm job retry {id}`",
            n(counts.dead, "task")
        );
        reasons.push(reason("dead", counts.dead, words));
    }
    reasons
}

fn last_error<'a>(mut failed: impl Iterator<Item = &'a Exception>) -> String {
    failed.next().map_or_else(String::new, |e| {
        format!(", e.g. task {}: {}", e.task, e.last_error)
    })
}

/// Why pending tasks of an active job are not leased.
fn waiting(facts: &JobFacts, reasons: &mut Vec<Reason>) {
    let Holdups {
        ready,
        waiting,
        next_ms,
        failed,
    } = &facts.holdups;
    if facts.paused {
        let words = format!(
            "the job is held: {} not begun until `picofarm job resume {}`",
            n(facts.counts.pending, "task"),
            facts.job
        );
        reasons.push(reason("paused", facts.counts.pending, words));
        return;
    }
    if *ready > 0 {
        reasons.push(unleased(facts, *ready));
    }
    if *waiting > 0 {
        let soon = next_ms.map_or_else(String::new, |at| {
            format!(", the first for another {}", span(at - facts.now_ms))
        });
        let last = last_error(failed.iter().filter(|e| !e.dead));
        let words = format!(
            "{} after a failure before the next attempt{soon}{last}",
            if *waiting == 1 {
                "1 task waits".into()
            } else {
                format!("{waiting} tasks wait")
            }
        );
        reasons.push(Reason {
            until_ms: *next_ms,
            ..reason("after_failure", *waiting, words)
        });
    }
}

/// Which stages wait for others.
fn blocked(facts: &JobFacts, reasons: &mut Vec<Reason>) {
    let stands = |need: &String| {
        let stage = facts.stages.iter().find(|s| s.name == *need);
        let done = stage.is_some_and(|s| s.state == StageState::Done);
        (!done).then(|| match stage {
            Some(s) if s.state == StageState::Failed => {
                format!("{need:?} ({} given up)", n(s.tasks.dead, "task"))
            }
            Some(s) => format!("{need:?} ({} of {} done)", s.tasks.done, s.tasks.total),
            None => format!("{need:?}"),
        })
    };
    for stage in &facts.stages {
        if stage.state != StageState::Blocked {
            continue;
        }
        let needs: Vec<String> = stage.needs.iter().filter_map(stands).collect();
        let words = format!(
            "{} of stage {:?} after {}",
            n(stage.tasks.pending, "task"),
            stage.name,
            needs.join(", ")
        );
        reasons.push(reason("blocked", stage.tasks.pending, words));
    }
}

/// Why tasks that may run at once are not leased.
fn unleased(facts: &JobFacts, ready: u64) -> Reason {
    let tasks = n(ready, "task");
    let others = match facts.elsewhere {
        0 => String::new(),
        count => format!(
            "; {} connected to other coordinators, which this one cannot ask",
            are(count)
        ),
    };
    if facts.candidates.is_empty() {
        let words = match facts.elsewhere {
            0 => format!(
                "no worker is connected, and {tasks} could run: start one with `picofarm worker`"
            ),
            _ => format!("no worker is connected here for {tasks}{others}"),
        };
        let code = if facts.elsewhere == 0 {
            "no_workers"
        } else {
            "elsewhere"
        };
        return reason(code, ready, words);
    }
    let able: Vec<_> = facts
        .candidates
        .iter()
        .filter(|c| c.may_run.is_ok())
        .collect();
    if able.is_empty() {
        let mut whys: Vec<(&str, &str)> = facts
            .candidates
            .iter()
            .filter_map(|c| Some((c.may_run.as_ref().err()?.as_str(), c.name.as_str())))
            .collect();
        whys.sort_unstable();
        whys.dedup_by_key(|(why, _)| *why);
        let whys: Vec<String> = whys
            .iter()
            .map(|(why, name)| format!("{why} ({name})"))
            .collect();
        let words = format!(
            "no connected worker may run {tasks}: {}{others}",
            whys.join("; ")
        );
        return reason("unable", ready, words);
    }
    let idle = able.iter().filter(|c| c.idle && !c.quarantined).count();
    if idle > 0 {
        let words = format!(
            "{tasks} about to be leased: {} for work",
            if idle == 1 {
                "1 worker asks".into()
            } else {
                format!("{idle} workers ask")
            }
        );
        return reason("starting", ready, words);
    }
    if let Some(first) = facts.ahead.first() {
        let more = match facts.ahead.len() {
            1 => String::new(),
            count => format!(" and {} more", n(count as u64 - 1, "job")),
        };
        let words = format!("{tasks} behind job {first}{more}, which goes first");
        return reason("behind", ready, words);
    }
    let held = able.iter().filter(|c| c.quarantined).count();
    let probation = match held {
        0 => String::new(),
        _ => format!(" ({held} of them on probation with tasks that crashed before)"),
    };
    let words = format!(
        "{tasks} behind others: {} that may run them {} busy{probation}{others}",
        if able.len() == 1 {
            "the one worker".into()
        } else {
            format!("all {} workers", able.len())
        },
        if able.len() == 1 { "is" } else { "are" },
    );
    reason("busy", ready, words)
}

fn are(count: u32) -> String {
    if count == 1 {
        "1 worker is".into()
    } else {
        format!("{count} workers are")
    }
}

/// What became of a task and why.
pub fn task(facts: TaskFacts) -> TaskExplanation {
    let (failures, crashes, last_error) = facts
        .record
        .exception
        .as_ref()
        .map(|e| (e.failures, e.crashes, e.last_error.clone()))
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
            "given up after {} of {} failures and {} of {} lost workers: {last_error}; mend the cause, then \
             `picofarm job retry {}`",
            failures, facts.limits.max_failures, crashes, facts.limits.max_crashes, facts.job
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

/// Whether a line of history says that a worker handed in a result.
pub fn committed(event: &Event) -> bool {
    match event.kind {
        EventKind::Committed => true,
        EventKind::Reused => !event.worker.is_empty(),
        _ => false,
    }
}

/// Why a task was run more than once: what ended each lease but the last.
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
            // A loss is told twice, for the lease and for the task in hand: the first says enough.
            _ if why.is_some() => continue,
            EventKind::Expired => format!("{} was lost with it: {}", event.worker, event.message),
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

#[cfg(test)]
mod tests;
