//! Following a job until it ends: progress, ETA, and the verdict.

use std::time::{Duration, Instant};

use picofarm_proto::{
    ids::JobId,
    model::{EventKind, JobState, JobStatus, StageStatus},
};

use crate::{
    client::Client,
    error::{CliError, Code, Result},
    output::{Meter, Output, duration},
};

/// How to show it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Show {
    /// Progress and failures.
    Progress,
    /// Nothing.
    Nothing,
}

/// Follows `job` until it ends, through losses of the connection.
///
/// # Errors
/// The coordinator refuses, or stays away for a minute.
pub async fn follow(
    client: &mut Client,
    job: JobId,
    output: Output,
    show: Show,
) -> Result<JobStatus> {
    let mut meter = Meter::new(if show == Show::Nothing {
        Output { json: true }
    } else {
        output
    });
    let mut pace = Pace::default();
    let mut seen = 0;
    let mut away: Option<Instant> = None;
    loop {
        let lost = match stream(client, job, output, show, &mut meter, &mut pace, &mut seen).await {
            Ok(Some(status)) => {
                meter.finish();
                return Ok(status);
            }
            Ok(None) => None,
            Err(e) if e.code == Code::Coordinator && !e.denied => Some(e),
            Err(e) => return Err(e),
        };
        let since = *away.get_or_insert_with(Instant::now);
        if since.elapsed() > Duration::from_secs(60) {
            meter.finish();
            return Err(lost.unwrap_or_else(|| {
                CliError::new(
                    Code::Coordinator,
                    format!("the coordinator at {} is gone", client.url()),
                )
            }));
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
        if let Ok(again) = client.reconnect().await {
            *client = again;
            away = None;
        }
    }
}

async fn stream(
    client: &mut Client,
    job: JobId,
    output: Output,
    show: Show,
    meter: &mut Meter,
    pace: &mut Pace,
    seen: &mut u64,
) -> Result<Option<JobStatus>> {
    let mut watch = client.watch(job).await?;
    while let Some(status) = watch.next().await? {
        if show == Show::Progress {
            if output.json {
                output.result(&status, String::new);
            }
            failures(client, job, meter, seen).await?;
            let (fraction, message) = pace.describe(&status);
            meter.at(fraction, message);
        }
        if status.state != JobState::Active {
            return Ok(Some(status));
        }
    }
    Ok(None)
}

/// Prints failures that happened since the last look.
async fn failures(client: &mut Client, job: JobId, meter: &Meter, seen: &mut u64) -> Result<()> {
    for event in client.events(job, *seen, None).await? {
        *seen = event.sequence;
        if matches!(
            event.kind,
            EventKind::Failed
                | EventKind::Released
                | EventKind::Dead
                | EventKind::Expired
                | EventKind::Alarm
                | EventKind::Waiting
        ) {
            let task = event.task.map(|t| format!("task {t} ")).unwrap_or_default();
            meter.line(
                &format!(
                    "{task}{:?} on {}: {}",
                    event.kind, event.worker, event.message
                )
                .to_lowercase(),
            );
        }
    }
    Ok(())
}

/// Share done and time left, from the pace since we began to watch.
#[derive(Default)]
struct Pace {
    start: Option<(Instant, f64)>,
}

impl Pace {
    fn describe(&mut self, s: &JobStatus) -> (f64, String) {
        let running: f64 = s.running.iter().map(|r| f64::from(r.fraction)).sum();
        let done = (s.tasks.done + s.tasks.dead) as f64 + running;
        let total = s.tasks.total.max(1) as f64;
        let (at, first) = *self.start.get_or_insert((Instant::now(), done));
        let elapsed = at.elapsed().as_secs_f64();
        let rate = (done - first) / elapsed.max(1e-3);
        let eta = if elapsed > 2.0 && rate > 0.0 && done < total {
            format!(", about {} left", duration((total - done) / rate))
        } else {
            String::new()
        };
        let dead = match s.tasks.dead {
            0 => String::new(),
            n => format!(", {n} dead"),
        };
        let reused = match s.tasks.reused {
            0 => String::new(),
            n => format!(" ({n} reused)"),
        };
        let renders = |s: &StageStatus| s.kind == "render";
        let what = match s.stages.iter().all(renders) {
            true => "scenes",
            false => "tasks",
        };
        let at = match &s.running[..] {
            [only] if !only.text.is_empty() => format!(", {}", only.text),
            _ => String::new(),
        };
        let message = format!(
            "{}/{} {what}{reused}{dead}, {} worker{}{at}{eta}",
            s.tasks.done,
            s.tasks.total,
            s.workers,
            if s.workers == 1 { "" } else { "s" },
        );
        (done / total, message)
    }
}

/// The exit of a command that followed a job.
///
/// # Errors
/// Exit code 5 unless every task is done.
pub fn verdict(status: &JobStatus) -> Result<()> {
    let failed = |what: &str, hint: String| {
        Err(CliError::new(Code::JobFailed, format!("job {}: {what}", status.id)).hint(hint))
    };
    match status.state {
        JobState::Done | JobState::Active => Ok(()),
        JobState::Failed => failed(
            &format!(
                "{} of {} tasks are dead",
                status.tasks.dead, status.tasks.total
            ),
            format!(
                "see `picofarm job logs {0}`, mend the cause, then `picofarm job retry {0}`",
                status.id
            ),
        ),
        JobState::Cancelled => failed("was cancelled", "submit it again with --again".into()),
    }
}
