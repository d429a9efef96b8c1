//! Explains why a job's tasks do not run.

use picofarm_catalog::{Exception, Holdups};
use picofarm_proto::{
    messages::{Event, EventKind, JobState, Reason, StageState, StageStatus, TaskCounts},
    spec::{
        matrix::{same_matrix, together},
        memory::gib,
    },
};

use super::{
    facts::JobFacts,
    reason::{n, reason},
    waits::{over_bytes, over_quota, short_of_time, waits_for_jobs},
};
use crate::core::{Candidate, NotEligible, span};

/// Returns why a job's tasks do not run, most important reason first. Never empty.
pub fn job(facts: &JobFacts) -> Vec<Reason> {
    let (counts, id) = (&facts.counts, facts.job);
    let mut reasons = Vec::new();
    match facts.state {
        JobState::Done => {
            reasons.push(reason("ended", counts.total, "every task is done".into()));
        }
        JobState::Cancelled => {
            let left = counts.total - counts.done;
            let tasks = n(left, "task");
            let (code, words) = match &facts.deadline {
                Some(deadline) => (
                    "deadline",
                    format!(
                        "the job's deadline passed (limits.deadline = {deadline:?}) with {tasks} not done; set a later \
                         limits.deadline in its file, or none, and submit it again (what is done is reused)"
                    ),
                ),
                None => (
                    "cancelled",
                    format!(
                        "the job was cancelled with {tasks} not done; submit it with --again to run them (what is done is reused)"
                    ),
                ),
            };
            reasons.push(reason(code, left, words));
        }
        JobState::Failed => blocked(facts, &mut reasons),
        JobState::Active => {
            waiting(facts, &mut reasons);
            blocked(facts, &mut reasons);
            if counts.leased > 0 {
                reasons.push(reason("leased", counts.leased, leased_words(facts)));
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
            "{} given up{last}; correct the cause, then `picofarm job retry {id}`",
            n(counts.dead, "task")
        );
        reasons.push(reason("dead", counts.dead, words));
    }
    reasons
}

/// Describes the leased tasks. A worker runs a few tasks of a lease at a time, mostly one.
fn leased_words(facts: &JobFacts) -> String {
    const SHOWN: usize = 4;
    let under = format!("{} under lease at workers", n(facts.counts.leased, "task"));
    let shown = facts.running.iter().take(SHOWN).map(|r| {
        let at = match &*r.text {
            "" => String::new(),
            text => format!(", {text}"),
        };
        let percent = f64::from(r.fraction) * 100.0;
        format!("task {} on {} ({percent:.0} %{at})", r.index, r.worker)
    });
    let shown: Vec<String> = shown.collect();
    let silent = facts
        .candidates
        .iter()
        .filter_map(|c| Some((c, c.silent_ms?)));
    let silent: Vec<String> = silent
        .map(|(c, ms)| format!("; worker {} was not heard of for {}", c.name, span(ms)))
        .collect();
    let running = match facts.running.len() {
        0 => ", none of which has reported yet".to_owned(),
        count => {
            let more = if count > SHOWN { ", …" } else { "" };
            let verb = if count == 1 { "runs" } else { "run" };
            format!(", of which {count} {verb}: {}{more}", shown.join(", "))
        }
    };
    format!("{under}{running}{}", silent.concat())
}

fn last_error<'a>(mut failed: impl Iterator<Item = &'a Exception>) -> String {
    failed.next().map_or_else(String::new, |e| {
        format!(", e.g. task {}: {}", e.task, e.last_error)
    })
}

/// Explains why pending tasks of an active job are not leased.
fn waiting(facts: &JobFacts, reasons: &mut Vec<Reason>) {
    let Holdups {
        ready,
        waiting,
        next_ms,
        failed,
        after,
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
    if !after.is_empty() {
        reasons.push(waits_for_jobs(facts, after));
        return;
    }
    if let Some(why) = facts.over_bytes.as_ref().filter(|_| *ready > 0) {
        reasons.push(over_bytes(*ready, why));
        return;
    }
    let shared = facts.shared.min(*ready);
    if shared > 0 {
        let words = format!(
            "{} under way for another job with the same outputs, whose results count here too",
            n(shared, "task")
        );
        reasons.push(reason("shared", shared, words));
    }
    if *ready > shared {
        reasons.push(unleased(facts, *ready - shared));
    }
    if *waiting > 0 {
        let soon = next_ms.map_or_else(String::new, |at| {
            format!(", the first for another {}", span(at - facts.now_ms))
        });
        let last = match last_error(failed.iter().filter(|e| !e.dead)) {
            // A returned task is charged to nobody, so only the history contains its reason.
            none if none.is_empty() => facts.setback.as_ref().map_or(none, setback),
            last => last,
        };
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

/// Describes the last interruption of a task.
fn setback(event: &Event) -> String {
    let task = event
        .task
        .map_or_else(String::new, |task| format!(" task {task}"));
    let on = match &*event.worker {
        "" => String::new(),
        worker => format!(" on {worker}"),
    };
    format!("; the last:{task}{on}: {}", event.message)
}

/// Explains which stages wait for others.
fn blocked(facts: &JobFacts, reasons: &mut Vec<Reason>) {
    // Stages of one matrix are grouped.
    let stands = |needs: &[String]| {
        let named = |s: &&StageStatus| needs.contains(&s.name);
        let stages: Vec<&StageStatus> = facts.stages.iter().filter(named).collect();
        let left = stages.iter().filter(|s| s.state != StageState::Done);
        if left.count() == 0 && stages.len() == needs.len() {
            return None;
        }
        let sum = |of: fn(&TaskCounts) -> u64| stages.iter().map(|s| of(&s.tasks)).sum::<u64>();
        let name = together(needs);
        Some(if stages.is_empty() {
            format!("{name:?}")
        } else if stages.iter().any(|s| s.state == StageState::Failed) {
            format!("{name:?} ({} given up)", n(sum(|t| t.dead), "task"))
        } else {
            format!(
                "{name:?} ({} of {} done)",
                sum(|t| t.done),
                sum(|t| t.total)
            )
        })
    };
    for stage in &facts.stages {
        if stage.state != StageState::Blocked {
            continue;
        }
        let groups = stage.needs.chunk_by(|a, b| same_matrix(a, b));
        let needs: Vec<String> = groups.filter_map(stands).collect();
        let words = format!(
            "{} of stage {:?} after {}",
            n(stage.tasks.pending, "task"),
            stage.name,
            needs.join(", ")
        );
        reasons.push(reason("blocked", stage.tasks.pending, words));
    }
}

/// Explains why tasks that could run now are not leased.
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
                "no worker is connected, and {tasks} could run: {}{}",
                starters(facts),
                lately(facts)
            ),
            _ => format!(
                "no worker is connected here for {tasks}{others}{}",
                lately(facts)
            ),
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
    if let Some(reason) = short_of_time(facts, ready, &able) {
        return reason;
    }
    if let Some(reason) = over_quota(facts, ready, &able) {
        return reason;
    }
    if able.is_empty() {
        let (small, others_say): (Vec<&Candidate>, Vec<&Candidate>) = facts
            .candidates
            .iter()
            .partition(|c| c.lacks_memory.is_some());
        let memory = largest(&small);
        let mut whys: Vec<(&str, &str)> = others_say
            .iter()
            .filter_map(|c| Some((c.may_run.as_ref().err()?.words(), c.name.as_str())))
            .collect();
        whys.sort_unstable();
        whys.dedup_by_key(|(why, _)| *why);
        let whys = whys.iter().map(|(why, name)| format!("{why} ({name})"));
        let whys: Vec<String> = memory.into_iter().chain(whys).collect();
        let waits = |c: &Candidate| matches!(c.may_run, Err(NotEligible::Store(_)));
        if facts.candidates.iter().any(waits) {
            let words = format!("{tasks} not begun: {}{others}", whys.join("; "));
            return reason("store", ready, words);
        }
        let words = format!(
            "no connected worker may run {tasks}: {}{others}",
            whys.join("; ")
        );
        return reason("unable", ready, words);
    }
    if able.iter().all(|c| c.silent_ms.is_some()) {
        let named = able.iter().take(4).map(|c| {
            let silent = span(c.silent_ms.unwrap_or_default());
            format!("{} for {silent}", c.name)
        });
        let named: Vec<String> = named.collect();
        let words = format!(
            "{tasks} wait: of {} that may run them nothing was heard ({}), although connected: frozen, suspended or \
             overloaded; what they had passes on to others when its lease runs out{others}",
            if able.len() == 1 {
                "the one worker".into()
            } else {
                format!("all {} workers", able.len())
            },
            named.join(", ")
        );
        return reason("silent", ready, words);
    }
    let asks = |c: &&&Candidate| c.idle && !c.quarantined;
    let idle = able.iter().filter(asks).filter(|c| c.gets).count();
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
    if facts.suspects > 0 && able.iter().any(|c| asks(&c)) {
        let words = format!(
            "{tasks} wait for a worker with nothing else in hand: workers were lost while they ran them{others}"
        );
        return reason("suspects", ready, words);
    }
    let ahead = facts.ahead.len() as u64 + facts.unseen;
    if ahead > 0 {
        let which = match (facts.ahead.first(), ahead) {
            (Some(first), 1) => format!("job {first}"),
            (Some(first), count) => format!("job {first} and {} more", n(count - 1, "job")),
            (None, count) => format!("{} of others", n(count, "job")),
        };
        let words = format!("{tasks} behind {which}, which goes first");
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

/// Describes who starts workers, and which pools cannot.
fn starters(facts: &JobFacts) -> String {
    let able = facts.pools.iter().find(|pool| pool.refused.is_none());
    if let Some(pool) = able {
        return format!(
            "pool {} starts workers as its batch system allows (`picofarm autoalloc` prints each decision)",
            pool.name
        );
    }
    let cannot = facts.pools.iter().filter_map(|pool| {
        let why = pool.refused.as_ref()?;
        Some(format!("; pool {} starts none: {why}", pool.name))
    });
    let cannot: Vec<String> = cannot.collect();
    format!("start one with `picofarm worker`{}", cannot.concat())
}

/// Describes what happened to the leases of recently connected workers.
fn lately(facts: &JobFacts) -> String {
    const RECENT_MS: i64 = 600_000;
    let back = facts.setback.as_ref().filter(|event| {
        matches!(event.kind, EventKind::Released | EventKind::Expired)
            && facts.now_ms - event.at_ms <= RECENT_MS
    });
    let Some(event) = back else {
        return String::new();
    };
    let failed = facts.holdups.failed.iter();
    let most = failed.max_by_key(|e| e.interruptions);
    let count = most.filter(|e| e.interruptions > 0).map(|e| {
        format!(
            "; task {} was interrupted {} so far",
            e.task,
            n(u64::from(e.interruptions), "time")
        )
    });
    format!(
        "; the last one, {}, gave a lease back {} ago: {}{}",
        event.worker,
        span(facts.now_ms - event.at_ms),
        event.message,
        count.unwrap_or_default()
    )
}

/// Describes the memory that a task needs and that the largest of these too small workers has.
fn largest(small: &[&Candidate]) -> Option<String> {
    let memory = |c: &&&Candidate| c.lacks_memory.map(|(needed, there)| (there, needed));
    let largest = small.iter().max_by_key(memory)?;
    let (needed, there) = largest.lacks_memory?;
    Some(format!(
        "each needs about {} of memory; the largest worker has {} for tasks ({})",
        gib(needed),
        gib(there),
        largest.name
    ))
}

fn are(count: u32) -> String {
    if count == 1 {
        "1 worker is".into()
    } else {
        format!("{count} workers are")
    }
}
