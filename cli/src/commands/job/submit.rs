//! Formats the result of `job submit`, including when an identical job exists.

use picofarm_proto::messages::{JobPlan, JobState, JobStatus};
use serde_json::json;

use super::finish::finish;
use crate::{
    client::{
        Client, Submitted,
        follow::{Show, follow, verdict},
    },
    error::Result,
    output::{
        Output,
        describe::{counts, describe_plan, state, unverified},
    },
};

/// Describes the state of an existing job with the same spec, because a submission returns that
/// job.
pub async fn twin(client: &mut Client, plan: &JobPlan) -> String {
    let Some(job) = plan.existing_job else {
        return String::new();
    };
    match client.status(job).await {
        Ok(status) => line(&status),
        // The job may belong to another user, and then only its id is known.
        Err(_) => String::new(),
    }
}

fn line(s: &JobStatus) -> String {
    let (id, counts) = (s.id, counts(s));
    match s.state {
        JobState::Active if s.paused => format!(
            "  it is held ({counts}): submitting begins nothing; let it go on with `picofarm job resume {id}`\n"
        ),
        JobState::Active => format!(
            "  it is active ({counts}): submitting answers with it, and runs nothing twice\n"
        ),
        JobState::Done => "  it is done; its results are reused\n".to_owned(),
        JobState::Failed => format!(
            "  it has ended with dead tasks ({counts}): submitting runs nothing; `picofarm job retry {id}` runs those again, \
             and `--again` makes a new job of it\n"
        ),
        JobState::Cancelled => match s.passed_deadline() {
            Some(deadline) => format!(
                "  its deadline passed ({counts}): submitting runs nothing until limits.deadline = {deadline:?} is later, or left out\n"
            ),
            None => format!(
                "  it was cancelled ({counts}): submitting runs nothing unless with --again\n"
            ),
        },
    }
}

/// Prints the result of a submission, and follows the job if requested.
///
/// # Errors
/// Fails if an identical job exists and has failed: nothing runs unless it is submitted with
/// --again.
pub async fn answer(
    client: &mut Client,
    submitted: Submitted,
    watch: bool,
    output: Output,
) -> Result<()> {
    let Submitted { job, existed, plan } = submitted;
    let there = match existed {
        true => client.status(job).await.ok(),
        false => None,
    };
    output.result(
        &json!({"job": job, "existed": existed, "plan": plan}),
        || match &there {
            Some(status) => {
                let state = state(status);
                let unverified = unverified(status);
                format!(
                    "job {job} was there already: {state}; {}\n{unverified}",
                    counts(status)
                )
            }
            None if existed => format!("job {job} was there already\n"),
            None => format!("job {job}\n{}", describe_plan(&plan)),
        },
    );
    if let Some(status) = there
        && matches!(status.state, JobState::Failed | JobState::Cancelled)
    {
        return verdict(&status);
    }
    if watch {
        let status = follow(client, job, output, Show::Progress).await?;
        return finish(client, &status, output).await;
    }
    output.say(format!("follow it with `picofarm job watch {job}`"));
    Ok(())
}
