//! Formats jobs, plans and events as text.

use std::collections::BTreeSet;

use picofarm_proto::{
    messages::{Estimate, Event, JobPlan, JobStatus, StagePlan},
    show,
    spec::{
        JobSpec,
        matrix::{same_matrix, together},
        memory::gib,
    },
};

use crate::output::{bytes, duration, table};

pub fn describe_plan(plan: &JobPlan) -> String {
    let mut text = format!(
        "{} tasks: {}\n",
        plan.total,
        parts(plan.reuse, plan.taken, plan.run)
    );
    let several = plan.stages.len() > 1;
    let groups = plan
        .stages
        .chunk_by(|a, b| a.kind == b.kind && same_matrix(&a.name, &b.name));
    for stages in groups {
        if several {
            let names: Vec<&str> = stages.iter().map(|stage| &*stage.name).collect();
            let many = match stages.len() {
                1 => String::new(),
                count => format!(", {count} stages"),
            };
            text += &format!(
                "  {} ({}{many}): {}\n",
                show::line(&together(&names)),
                show::line(&stages[0].kind),
                parts(
                    stages.iter().map(|stage| stage.reuse).sum(),
                    stages.iter().map(|stage| stage.taken).sum(),
                    stages.iter().map(|stage| stage.run).sum(),
                ),
            );
        }
        let indent = if several { "    " } else { "  " };
        text += &reasons(stages, indent);
        let running = stages.iter().filter(|stage| stage.run > 0);
        let most = running.map(|stage| stage.memory_bytes).max().unwrap_or(0);
        if most > 0 {
            let (each, most) = (
                if stages.len() > 1 { "at most" } else { "about" },
                gib(most),
            );
            text += &format!("{indent}each takes {each} {most} of memory\n");
        }
        text += &cost(stages, indent);
    }
    if let Some(job) = plan.existing_job {
        text += &format!("  job {job} has this exact spec\n");
    }
    for warning in &plan.warnings {
        text += &format!("  warning: {}\n", show::line(warning));
    }
    text
}

/// What becomes of tasks, in numbers.
fn parts(reuse: u64, taken: u64, run: u64) -> String {
    match taken {
        0 => format!("{reuse} reuse, {run} run"),
        _ => format!("{reuse} reuse, {taken} taken over from the store, {run} run"),
    }
}

/// How long the tasks of a group of stages take and how much they store, as far as it can be told.
fn cost(stages: &[StagePlan], indent: &str) -> String {
    let running = || stages.iter().filter(|stage| stage.run > 0);
    let sum = |each: &dyn Fn(&StagePlan) -> Option<Estimate>| {
        running().try_fold(
            Estimate {
                low: 0.0,
                high: 0.0,
            },
            |sum, stage| Some(sum.plus(each(stage)?)),
        )
    };
    if running().next().is_none() {
        return String::new();
    }
    let basis = match running().all(|stage| stage.measured) {
        true => "from earlier tasks of this farm",
        false => "a rule of thumb, since no task like these has run on this farm",
    };
    let workers = running().map(|stage| stage.workers).min().unwrap_or(0);
    let at_once = |stage: &StagePlan| stage.run.min(u64::from(stage.workers.max(1))) as f64;
    let time = sum(&|stage| Some(stage.task_seconds?.times(stage.run as f64 / at_once(stage))));
    let mut text = String::new();
    if let Some(time) = time {
        let on = match workers {
            0 => "on one worker, if it were there".to_owned(),
            1 => "on 1 worker".to_owned(),
            n => format!("on {n} workers"),
        };
        text += &format!(
            "{indent}takes {} to {} {on} ({basis})\n",
            duration(time.low),
            duration(time.high)
        );
    }
    if let Some(stored) = sum(&|stage| Some(stage.task_bytes?.times(stage.run as f64))) {
        text += &format!(
            "{indent}stores {} to {}\n",
            bytes(stored.low as u64),
            bytes(stored.high as u64)
        );
    }
    text
}

/// Explains why the tasks of a stage, or of the stages of a matrix, run or do not.
fn reasons(stages: &[StagePlan], indent: &str) -> String {
    const SHOWN: usize = 2;
    let mut seen = BTreeSet::new();
    let all = stages.iter().flat_map(|stage| {
        let reasons = stage.reasons.iter();
        reasons.map(move |reason| (&*stage.name, reason))
    });
    let different: Vec<(&str, &String)> = all.filter(|(_, reason)| seen.insert(*reason)).collect();
    let mut text = String::new();
    for (name, reason) in different.iter().take(SHOWN.max(stages[0].reasons.len())) {
        let of = match (stages.len(), different.len()) {
            (1, _) => String::new(),
            (_, 1) => "each: ".to_owned(),
            _ => format!("{}: ", show::line(name)),
        };
        text += &format!("{indent}{of}{}\n", show::line(reason));
    }
    let shown = text.lines().count();
    if different.len() > shown {
        let more = different.len() - shown;
        text += &format!("{indent}and {more} more (--json has them all)\n");
    }
    text
}

pub fn state(status: &JobStatus) -> String {
    match status.paused {
        true => "held".into(),
        false => format!("{:?}", status.state).to_lowercase(),
    }
}

/// Returns a line about results that the coordinator has not found in their store.
pub fn unverified(s: &JobStatus) -> String {
    match s.unverified {
        0 => String::new(),
        n => format!(
            "  {n} results are reported by workers and not verified in their store by the coordinator (`picofarm job plan` \
             with the same job file says why)\n"
        ),
    }
}

pub fn describe(s: &JobStatus) -> String {
    let mut text = format!(
        "job {} \"{}\": {}\n  {}\n",
        s.id,
        show::line(&s.name),
        state(s),
        counts(s)
    );
    text += &unverified(s);
    if let Some(mean) = s.mean_task_seconds {
        text += &format!("  {} a task on average\n", duration(mean));
    }
    if let Some(end) = s.ended_at_ms {
        text += &format!(
            "  took {}\n",
            duration((end - s.submitted_at_ms) as f64 / 1000.0)
        );
    }
    let several = s.stages.len() > 1;
    if several {
        text += &describe_stages(s);
    }
    for r in &s.running {
        let of = match s.stages.get(r.stage as usize) {
            Some(stage) if several => format!("{} ", show::line(&stage.name)),
            _ => String::new(),
        };
        text += &format!(
            "  {of}task {} on {}: {:.0} % after {}{}\n",
            r.index,
            show::line(&r.worker),
            r.fraction * 100.0,
            duration(r.seconds),
            match &*r.text {
                "" => String::new(),
                text => format!(": {}", show::line(text)),
            }
        );
    }
    text + &places(&s.spec)
}

/// Returns the locations of a job's results.
fn places(spec: &JobSpec) -> String {
    const SHOWN: usize = 4;
    let mut text = String::new();
    let mut models: Vec<(&String, Vec<&str>)> = Vec::new();
    for stage in &spec.stages {
        if let Some((store, dataset)) = stage.task.writes() {
            let line = format!("data set {store}/{dataset}");
            text += &format!("  {}\n", show::line(&line));
        }
        if let Some((store, model)) = stage.task.trains() {
            match models.iter_mut().find(|(other, _)| *other == store) {
                Some((_, names)) => names.push(model),
                None => models.push((store, vec![model])),
            }
        }
        if let Some((store, report)) = stage.task.reports() {
            let line = format!("report {store}/reports/{report}");
            text += &format!("  {}\n", show::line(&line));
        }
    }
    for (store, names) in models {
        let more = if names.len() > SHOWN { ", …" } else { "" };
        let names = names[..names.len().min(SHOWN)].join(", ");
        let line = format!("models in {store}: {names}{more}");
        text += &format!("  {}\n", show::line(&line));
    }
    text
}

/// Counts the tasks of a job by state. A lease can contain many tasks, but its worker runs one at a
/// time.
pub fn counts(s: &JobStatus) -> String {
    let t = &s.tasks;
    let running = s.running.len() as u64;
    let leased = match t.leased.saturating_sub(running) {
        0 => String::new(),
        waiting => format!("{waiting} leased and not begun, "),
    };
    format!(
        "{} tasks: {} done ({} reused), {running} running, {leased}{} pending, {} dead",
        t.total, t.done, t.reused, t.pending, t.dead
    )
}

fn describe_stages(s: &JobStatus) -> String {
    let header = [
        "  stage", "kind", "state", "done", "running", "leased", "pending", "dead", "needs",
    ];
    let rows = s.stages.iter().enumerate().map(|(at, stage)| {
        let t = &stage.tasks;
        let running = s.running.iter().filter(|r| r.stage as usize == at).count();
        vec![
            format!("  {}", stage.name),
            stage.kind.clone(),
            format!("{:?}", stage.state).to_lowercase(),
            format!("{}/{}", t.done, t.total),
            running.to_string(),
            t.leased.to_string(),
            t.pending.to_string(),
            t.dead.to_string(),
            needs(&stage.needs),
        ]
    });
    let header = header.map(String::from).to_vec();
    table(&std::iter::once(header).chain(rows).collect::<Vec<_>>())
}

/// Returns the stages that a stage needs, grouped by matrix.
fn needs(needs: &[String]) -> String {
    let groups = needs.chunk_by(|a, b| same_matrix(a, b));
    groups.map(together).collect::<Vec<_>>().join(", ")
}

pub fn describe_event(e: &Event) -> String {
    let stage = match e.stage {
        Some(stage) if stage > 0 => format!("stage {stage} "),
        _ => String::new(),
    };
    let task = match (e.task, e.lo, e.hi) {
        (Some(task), ..) => format!("{stage}task {task} "),
        (None, Some(lo), Some(hi)) => format!("{stage}tasks {lo}..{hi} "),
        _ => stage,
    };
    let worker = if e.worker.is_empty() {
        String::new()
    } else {
        format!("on {} ", e.worker)
    };
    let took = if e.seconds > 0.0 {
        format!("in {} ", duration(e.seconds))
    } else {
        String::new()
    };
    let kind = format!("{:?}", e.kind).to_lowercase();
    let text = format!(
        "{} {task}{kind} {worker}{took}{}",
        clock(e.at_ms),
        e.message
    );
    // Names and messages come from others, so an event is escaped to a single line.
    show::line(text.trim_end()).into_owned() + "\n"
}

/// Formats Unix milliseconds as UTC, e.g. `2026-11-21T10:15:30Z`.
pub fn clock(ms: i64) -> String {
    let (days, second) = (ms.div_euclid(86_400_000), ms.rem_euclid(86_400_000) / 1000);
    // Civil date from days since 1970-01-01 (Hinnant's algorithm).
    let z = days + 719_468;
    let (era, doe) = (z.div_euclid(146_097), z.rem_euclid(146_097));
    let yoe = (doe - doe / 1460 + doe / 36_524 - doe / 146_096) / 365;
    let doy = doe - (365 * yoe + yoe / 4 - yoe / 100);
    let mp = (5 * doy + 2) / 153;
    let (day, month) = (
        doy - (153 * mp + 2) / 5 + 1,
        if mp < 10 { mp + 3 } else { mp - 9 },
    );
    let year = yoe + era * 400 + i64::from(month <= 2);
    format!(
        "{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z",
        second / 3600,
        second / 60 % 60,
        second % 60
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clock_is_utc() {
        assert_eq!(clock(0), "1970-01-01T00:00:00Z");
        assert_eq!(clock(1_795_255_530_000), "2026-11-21T10:05:30Z");
    }

    #[test]
    fn a_plan_tells_stages_of_one_matrix_together() {
        let stage = |name: &str, reuse: u64, memory_bytes: u64, reasons: &[&str]| StagePlan {
            name: name.into(),
            kind: "train".into(),
            total: 1,
            reuse,
            taken: 0,
            run: 1 - reuse,
            memory_bytes,
            workers: 1,
            task_seconds: None,
            task_bytes: None,
            measured: false,
            reasons: reasons.iter().map(|r| (*r).to_owned()).collect(),
        };
        let stages = vec![
            stage("split", 1, 0, &["exists"]),
            stage("tof[1]", 1, 0, &["exists"]),
            stage("tof[2]", 1, 0, &["exists"]),
            stage("shadow[a]", 0, 1 << 30, &["new a"]),
            stage("shadow[b]", 0, 2 << 30, &["new b"]),
            stage("shadow[c]", 0, 1 << 30, &["new c"]),
            stage("last", 0, 0, &["old", "new"]),
        ];
        let plan = JobPlan {
            spec_hash: String::new(),
            total: 7,
            reuse: 3,
            taken: 0,
            run: 4,
            existing_job: None,
            stages,
            warnings: vec!["stage last: render.error = 0.1 %".into()],
        };
        let text = "7 tasks: 3 reuse, 4 run
  split (train): 1 reuse, 0 run
    exists
  tof[…] (train, 2 stages): 2 reuse, 0 run
    each: exists
  shadow[…] (train, 3 stages): 0 reuse, 3 run
    shadow[a]: new a
    shadow[b]: new b
    and 1 more (--json has them all)
    each takes at most 2.0 GiB of memory
  last (train): 0 reuse, 1 run
    old
    new
  warning: stage last: render.error = 0.1 %
";
        assert_eq!(describe_plan(&plan), text);
        let names = ["rooms", "tof[1]", "tof[2]", "shadow[1]"].map(str::to_owned);
        assert_eq!(needs(&names), "rooms, tof[…], shadow[1]");
    }
}
