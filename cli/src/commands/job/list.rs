//! `picofarm job list`: shows a page of the jobs.

use std::time::SystemTime;

use picofarm_proto::{
    messages::{JobState, JobSummary},
    show,
};
use serde_json::json;

use crate::{
    args::ListedState,
    client::{Client, Listing},
    error::Result,
    output::{Output, duration, table},
};

impl From<ListedState> for JobState {
    fn from(state: ListedState) -> Self {
        match state {
            ListedState::Active => Self::Active,
            ListedState::Done => Self::Done,
            ListedState::Failed => Self::Failed,
            ListedState::Cancelled => Self::Cancelled,
        }
    }
}

/// Shows the jobs selected by `ask`, and how to see more of them.
pub async fn run(client: &mut Client, ask: &Listing<'_>, output: Output) -> Result<()> {
    let (jobs, next) = client.list(ask).await?;
    let now_ms = SystemTime::UNIX_EPOCH
        .elapsed()
        .map_or(0, |since| since.as_millis() as i64);
    output.result(&json!({"jobs": jobs, "next_page": next}), || {
        describe(&jobs, now_ms)
    });
    if let Some(next) = next {
        let mut command = format!("picofarm job list --page {next} --limit {}", ask.limit);
        if let Some(state) = ask.state {
            command += &format!(" --state {}", format!("{state:?}").to_lowercase());
        }
        if let Some(user) = ask.user {
            command += &format!(" --user {user:?}");
        }
        output.say(format!("there are earlier ones: `{command}`"));
    }
    Ok(())
}

fn describe(jobs: &[JobSummary], now_ms: i64) -> String {
    if jobs.is_empty() {
        return "no jobs; submit one with `picofarm job submit FILE`".into();
    }
    let header = [
        "job", "name", "user", "age", "state", "done", "dead", "total", "left", "id",
    ]
    .map(String::from)
    .to_vec();
    let rows = jobs.iter().map(|j| {
        let state = match j.paused {
            true => "held".into(),
            false => format!("{:?}", j.state).to_lowercase(),
        };
        let done = match j.tasks.total {
            0 => j.tasks.done.to_string(),
            total => format!("{} ({} %)", j.tasks.done, 100 * j.tasks.done / total),
        };
        vec![
            j.number.to_string(),
            show::line(&j.name).into_owned(),
            show::line(&j.user).into_owned(),
            duration((now_ms - j.submitted_at_ms).max(0) as f64 / 1000.0),
            state,
            done,
            j.tasks.dead.to_string(),
            j.tasks.total.to_string(),
            j.left_s
                .map_or_else(String::new, |s| format!("about {}", duration(s as f64))),
            j.id.to_string(),
        ]
    });
    table(&std::iter::once(header).chain(rows).collect::<Vec<_>>())
}
