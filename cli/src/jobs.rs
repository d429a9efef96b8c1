//! `picofarm job …`.

use std::{path::Path, time::Duration};

use picofarm_proto::{
    ids::JobId,
    model::{Event, JobPlan, JobSpec, JobStatus},
};
use serde_json::json;

use crate::{
    args::{Job, JobKind},
    client::{Client, Page},
    error::{CliError, Code, Result, io},
    explain,
    follow::{Show, follow, verdict},
    jobfile,
    output::{Output, duration, table},
    settings::Settings,
    tail,
};

pub async fn run(command: Job, settings: &Settings, output: Output) -> Result<()> {
    if let Job::Init { file, kind } = &command {
        return init(file, *kind, output);
    }
    let spec = match &command {
        Job::Plan { file, scale } => {
            Some(jobfile::read_counted(file, scale.as_deref(), &settings.assets).await?)
        }
        Job::Submit {
            file,
            scale,
            force,
            from_stage,
            ..
        } => {
            let mut spec = jobfile::read_counted(file, scale.as_deref(), &settings.assets).await?;
            force_stages(&mut spec, *force, from_stage.as_deref())?;
            Some(spec)
        }
        _ => None,
    };
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    match command {
        Job::Init { .. } => Ok(()),
        Job::Plan { .. } => {
            let plan = client.plan(spec.expect("read above")).await?;
            output.result(&plan, || describe_plan(&plan));
            Ok(())
        }
        Job::Submit {
            only_failed: true,
            watch,
            ..
        } => {
            let plan = client.plan(spec.expect("read above")).await?;
            let job = plan.existing_job.ok_or_else(|| {
                CliError::input("--only-failed: this job was not submitted before")
                    .hint("submit it without --only-failed")
            })?;
            let retried = client.retry(job).await?;
            output.result(&json!({"job": job, "retried": retried}), || {
                format!("{retried} dead tasks of job {job} are pending again")
            });
            match watch {
                true => {
                    let status = follow(&mut client, job, output, Show::Progress).await?;
                    finish(&status, output)
                }
                false => Ok(()),
            }
        }
        Job::Submit { watch, again, .. } => {
            let submitted = client.submit(spec.expect("read above"), again).await?;
            let (job, existed) = (submitted.job, submitted.existed);
            output.result(
                &json!({"job": job, "existed": existed, "plan": submitted.plan}),
                || {
                    let was = if existed { " (was there already)" } else { "" };
                    format!("job {job}{was}\n{}", describe_plan(&submitted.plan))
                },
            );
            if watch {
                finish(
                    &follow(&mut client, job, output, Show::Progress).await?,
                    output,
                )
            } else {
                output.say(format!("follow it with `picofarm job watch {job}`"));
                Ok(())
            }
        }
        Job::List => {
            let jobs = client.list().await?;
            output.result(&jobs, || describe_list(&jobs));
            Ok(())
        }
        Job::Status { job } => {
            let job = client.find(&job).await?;
            let status = client.status(job).await?;
            output.result(&status, || describe(&status));
            Ok(())
        }
        Job::Watch { job } => {
            let job = client.find(&job).await?;
            finish(
                &follow(&mut client, job, output, Show::Progress).await?,
                output,
            )
        }
        Job::Wait { job, timeout_s } => {
            let job = client.find(&job).await?;
            let ended = follow(&mut client, job, output, Show::Nothing);
            let status = match timeout_s {
                None => ended.await?,
                Some(s) => tokio::time::timeout(Duration::from_secs_f64(s.clamp(0.0, 1e9)), ended)
                    .await
                    .map_err(|_| {
                        CliError::new(Code::Failed, format!("job {job} has not ended in {s} s"))
                            .hint(format!("see `picofarm job status {job}`"))
                    })??,
            };
            finish(&status, output)
        }
        Job::Cancel { job } => {
            let job = client.find(&job).await?;
            let status = client.cancel(job).await?;
            output.result(&status, || describe(&status));
            Ok(())
        }
        Job::Pause { job } => {
            let job = client.find(&job).await?;
            let status = client.pause(job, true).await?;
            output.result(&status, || describe(&status));
            Ok(())
        }
        Job::Resume { job } => {
            let job = client.find(&job).await?;
            let status = client.pause(job, false).await?;
            output.result(&status, || describe(&status));
            Ok(())
        }
        Job::Retry { job } => {
            let job = client.find(&job).await?;
            let retried = client.retry(job).await?;
            output.result(&json!({"job": job, "retried": retried}), || {
                format!("{retried} dead tasks of job {job} are pending again")
            });
            Ok(())
        }
        Job::Explain { job, stage, task } => {
            let job = client.find(&job).await?;
            let stage = position(&mut client, job, stage.as_deref()).await?;
            let explained = client.explain(job, stage.unwrap_or(0), task).await?;
            output.result(&explained, || explain::describe(&explained));
            Ok(())
        }
        Job::Logs {
            job,
            stage,
            task,
            last,
            follow,
            verbose,
        } => {
            let job = client.find(&job).await?;
            let page = Page {
                job: Some(job),
                stage: position(&mut client, job, stage.as_deref()).await?,
                task,
                after: 0,
                limit: last,
                newest: true,
                logs: verbose || task.is_some(),
            };
            if follow {
                return tail::follow(client, page, output).await;
            }
            let events = history(&mut client, page).await?;
            output.result(&events, || events.iter().map(describe_event).collect());
            Ok(())
        }
    }
}

fn init(file: &Path, kind: JobKind, output: Output) -> Result<()> {
    use std::io::Write;
    std::fs::File::create_new(file)
        .and_then(|mut f| f.write_all(crate::template::template(kind).as_bytes()))
        .map_err(|e| match e.kind() {
            std::io::ErrorKind::AlreadyExists => {
                CliError::input(format!("{} exists and is left as it is", file.display()))
                    .hint("name another file")
            }
            _ => io(file.display(), &e),
        })?;
    output.result(&json!({"file": file}), || {
        format!("wrote {0}; next: picofarm job plan {0}", file.display())
    });
    Ok(())
}

/// Marks what `--force` and `--from-stage` ask for. The job is one of its own: the same without would be there already.
fn force_stages(spec: &mut JobSpec, all: bool, from: Option<&str>) -> Result<()> {
    let mut forced: Vec<String> = Vec::new();
    if let Some(from) = from
        && spec.stage(from).is_none()
    {
        let names: Vec<&str> = spec.stages.iter().map(|s| &*s.name).collect();
        return Err(CliError::input(format!(
            "--from-stage: the job has no stage {from:?}; it has {}",
            names.join(", ")
        )));
    }
    for stage in &mut spec.stages {
        let needs = stage.needs.iter().any(|need| forced.contains(need));
        if all || from == Some(&*stage.name) || needs {
            stage.force = true;
            forced.push(stage.name.clone());
        }
    }
    if !forced.is_empty() {
        spec.nonce = uuid::Uuid::new_v4().to_string();
    }
    Ok(())
}

/// The position of a stage that is given by name or position.
async fn position(client: &mut Client, job: JobId, stage: Option<&str>) -> Result<Option<u32>> {
    let Some(stage) = stage else {
        return Ok(None);
    };
    let stages = client.status(job).await?.stages;
    let named = stages.iter().position(|s| s.name == stage);
    let at = named.or_else(|| stage.parse().ok().filter(|at| *at < stages.len()));
    let at = at.ok_or_else(|| {
        let names: Vec<&str> = stages.iter().map(|s| &*s.name).collect();
        CliError::input(format!(
            "--stage: job {job} has no stage {stage:?}; it has {}",
            names.join(", ")
        ))
    })?;
    Ok(u32::try_from(at).ok())
}

/// The last events, in order.
async fn history(client: &mut Client, page: Page) -> Result<Vec<Event>> {
    // A page of the coordinator's may be shorter than what is asked for: going forward, the last ones are kept.
    let (mut events, mut after) = (Vec::new(), 0);
    let last = page.limit as usize;
    loop {
        let next = Page {
            after,
            limit: 1000,
            newest: false,
            ..page
        };
        let (page, _) = client.history(next).await?;
        let Some(end) = page.last() else { break };
        after = end.sequence;
        events.extend(page);
        let surplus = events.len().saturating_sub(last);
        events.drain(..surplus);
    }
    Ok(events)
}

fn finish(status: &JobStatus, output: Output) -> Result<()> {
    output.result(status, || describe(status));
    verdict(status)
}

pub fn describe_plan(plan: &JobPlan) -> String {
    let mut text = format!(
        "{} tasks: {} reuse, {} run\n",
        plan.total, plan.reuse, plan.run
    );
    let several = plan.stages.len() > 1;
    for stage in &plan.stages {
        if several {
            text += &format!(
                "  {} ({}): {} reuse, {} run\n",
                stage.name, stage.kind, stage.reuse, stage.run
            );
        }
        for reason in &stage.reasons {
            let indent = if several { "    " } else { "  " };
            text += &format!("{indent}{reason}\n");
        }
    }
    if let Some(job) = plan.existing_job {
        text += &format!("  job {job} has this exact spec\n");
    }
    text
}

pub fn state(status: &JobStatus) -> String {
    match status.paused {
        true => "held".into(),
        false => format!("{:?}", status.state).to_lowercase(),
    }
}

fn describe_list(jobs: &[JobStatus]) -> String {
    if jobs.is_empty() {
        return "no jobs; submit one with `picofarm job submit FILE`".into();
    }
    let header = ["job", "name", "state", "done", "dead", "total"]
        .map(String::from)
        .to_vec();
    let rows = jobs.iter().map(|j| {
        vec![
            j.id.to_string(),
            j.name.clone(),
            state(j),
            j.tasks.done.to_string(),
            j.tasks.dead.to_string(),
            j.tasks.total.to_string(),
        ]
    });
    table(&std::iter::once(header).chain(rows).collect::<Vec<_>>())
}

pub fn describe(s: &JobStatus) -> String {
    let t = &s.tasks;
    let mut text = format!(
        "job {} \"{}\": {}\n  {} tasks: {} done ({} reused), {} running, {} pending, {} dead\n",
        s.id,
        s.name,
        state(s),
        t.total,
        t.done,
        t.reused,
        t.leased,
        t.pending,
        t.dead
    );
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
            Some(stage) if several => format!("{} ", stage.name),
            _ => String::new(),
        };
        text += &format!(
            "  {of}task {} on {}: {:.0} % after {}{}\n",
            r.index,
            r.worker,
            r.fraction * 100.0,
            duration(r.seconds),
            match &*r.text {
                "" => String::new(),
                text => format!(": {text}"),
            }
        );
    }
    for stage in &s.spec.stages {
        if let Some((store, dataset)) = stage.task.writes() {
            text += &format!("  data set {store}/{dataset}\n");
        }
    }
    text
}

fn describe_stages(s: &JobStatus) -> String {
    let header = [
        "  stage", "kind", "state", "done", "running", "pending", "dead", "needs",
    ];
    let rows = s.stages.iter().map(|stage| {
        let t = &stage.tasks;
        vec![
            format!("  {}", stage.name),
            stage.kind.clone(),
            format!("{:?}", stage.state).to_lowercase(),
            format!("{}/{}", t.done, t.total),
            t.leased.to_string(),
            t.pending.to_string(),
            t.dead.to_string(),
            stage.needs.join(", "),
        ]
    });
    let header = header.map(String::from).to_vec();
    table(&std::iter::once(header).chain(rows).collect::<Vec<_>>())
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
    format!(
        "{} {task}{kind} {worker}{took}{}",
        clock(e.at_ms),
        e.message
    )
    .trim_end()
    .to_owned()
        + "\n"
}

/// Unix milliseconds as UTC, e.g. `2026-11-21T10:15:30Z`.
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
    #[test]
    fn clock_is_utc() {
        assert_eq!(super::clock(0), "1970-01-01T00:00:00Z");
        assert_eq!(super::clock(1_795_255_530_000), "2026-11-21T10:05:30Z");
    }
}
