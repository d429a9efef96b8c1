//! Follows a job until it ends, across losses of the connection, and shows its verdicts.

use std::time::{Duration, Instant};

use picofarm_proto::{
    ids::JobId,
    messages::{EventKind, JobState, JobStatus},
};

use crate::{
    client::Client,
    error::{CliError, Code, Result},
    output::{Meter, Output, duration, pace::Pace},
};

/// Time for which a coordinator may be unreachable before following ends.
const AWAY: Duration = Duration::from_secs(60);
/// Wait before the first attempt to reconnect. Each further wait is twice as long.
const FIRST: Duration = Duration::from_millis(250);
/// Maximum wait between attempts.
const LONGEST: Duration = Duration::from_secs(5);

/// What to show while following.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Show {
    /// Progress and failures.
    Progress,
    /// Nothing.
    Nothing,
}

/// State that outlives a connection.
struct Watching {
    output: Output,
    show: Show,
    meter: Meter,
    pace: Pace,
    /// Sequence number of the last shown event.
    seen: u64,
}

/// Follows `job` until it ends, across losses of the connection.
///
/// # Errors
/// Fails if the coordinator refuses, or is unreachable for a minute (exit code 4).
pub async fn follow(
    client: &mut Client,
    job: JobId,
    output: Output,
    show: Show,
) -> Result<JobStatus> {
    let quiet = Output { json: true };
    let mut watching = Watching {
        output,
        show,
        meter: Meter::new(if show == Show::Nothing { quiet } else { output }),
        pace: Pace::default(),
        seen: 0,
    };
    loop {
        let lost = match stream(client, job, &mut watching).await {
            Ok(Some(status)) => {
                watching.meter.finish();
                return Ok(status);
            }
            Ok(None) => "it has ended".to_owned(),
            Err(e) if e.code == Code::Coordinator && !e.denied => e.message,
            Err(e) => return Err(e),
        };
        watching.meter.line(&format!(
            "the coordinator at {} is away ({lost}); asking again for up to {}",
            client.url(),
            duration(AWAY.as_secs_f64())
        ));
        let back = back(client, job).await;
        *client = match back {
            Ok(again) => again,
            Err(e) => {
                watching.meter.finish();
                return Err(e);
            }
        };
    }
}

/// Waits until a coordinator answers again.
///
/// # Errors
/// Fails if it refuses, or remains unreachable.
async fn back(client: &Client, job: JobId) -> Result<Client> {
    let since = Instant::now();
    let mut wait = FIRST;
    loop {
        tokio::time::sleep(wait).await;
        wait = (wait * 2).min(LONGEST);
        let error = match client.reconnect().await {
            Ok(again) => return Ok(again),
            Err(e) if e.code != Code::Coordinator || e.denied => return Err(e),
            Err(e) => e,
        };
        if since.elapsed() > AWAY {
            let what = format!(
                "the coordinator stayed away for {}: {}",
                duration(AWAY.as_secs_f64()),
                error.message
            );
            return Err(CliError::new(Code::Coordinator, what).hint(format!(
                "the job goes on when one runs again; then follow it with `picofarm job watch {job}`"
            )));
        }
    }
}

async fn stream(
    client: &mut Client,
    job: JobId,
    watching: &mut Watching,
) -> Result<Option<JobStatus>> {
    let mut watch = client.watch(job).await?;
    while let Some(status) = watch.next().await? {
        if watching.show == Show::Progress {
            if watching.output.json {
                watching.output.result(&status, String::new);
            }
            failures(client, job, watching).await?;
            let (fraction, message) = watching.pace.describe(&status, Instant::now());
            watching.meter.update(fraction, message);
        }
        if status.state != JobState::Active {
            return Ok(Some(status));
        }
    }
    Ok(None)
}

/// Prints failures since the last call.
async fn failures(client: &mut Client, job: JobId, watching: &mut Watching) -> Result<()> {
    for event in client.events(job, watching.seen, None).await? {
        watching.seen = event.sequence;
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
            let kind = format!("{:?}", event.kind).to_lowercase();
            let on = match &*event.worker {
                "" => String::new(),
                worker => format!(" on {worker}"),
            };
            let line = format!("{task}{kind}{on}: {}", event.message);
            watching.meter.line(&line);
        }
    }
    Ok(())
}

/// Returns the result of a command that followed a job.
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
                "see `picofarm job logs {0}`, correct the cause, then `picofarm job retry {0}`",
                status.id
            ),
        ),
        JobState::Cancelled => match status.passed_deadline() {
            Some(deadline) => failed(
                &format!("was cancelled as its deadline passed (limits.deadline = {deadline:?})"),
                "set a later limits.deadline in its file, or none, and submit it again: what is done is reused".into(),
            ),
            None => failed(
                "was cancelled",
                "submit its file again with --again: what is done is reused".into(),
            ),
        },
    }
}
