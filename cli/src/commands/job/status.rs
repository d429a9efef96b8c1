//! `picofarm job status`.

use picofarm_proto::{
    ids::JobId,
    messages::{JobState, JobStatus, Reason},
    show,
};
use serde::Serialize;

use crate::{
    client::Client,
    error::Result,
    output::{Output, describe::describe},
};

/// Reasons that concern a job as a whole: jobs in `after`, and the bounds on its user.
const SHOWN: [&str; 3] = ["after", "quota", "quota_bytes"];

#[derive(Serialize)]
struct Answer {
    #[serde(flatten)]
    status: JobStatus,
    /// What the job waits for.
    waits_for: Vec<Reason>,
}

/// Shows a job, with the jobs or the quota that it waits for.
///
/// # Errors
/// Fails if the coordinator does not answer.
pub async fn run(client: &mut Client, job: JobId, output: Output) -> Result<()> {
    let status = client.status(job).await?;
    let waits = status.state == JobState::Active && status.tasks.pending > 0;
    let mut reasons = match waits {
        true => client.explain(job, 0, None).await?.reasons,
        false => Vec::new(),
    };
    reasons.retain(|reason| SHOWN.contains(&&*reason.code));
    let answer = Answer {
        status,
        waits_for: reasons,
    };
    output.result(&answer, || {
        let mut text = describe(&answer.status);
        for reason in &answer.waits_for {
            text += &format!("  {}\n", show::line(&reason.words));
        }
        text
    });
    Ok(())
}
