//! The result of a job that was followed.

use picofarm_proto::messages::JobStatus;

use super::{dark, verdicts};
use crate::{
    client::{Client, follow::verdict},
    error::Result,
    output::{Output, describe::describe},
};

/// Prints the result.
///
/// # Errors
/// Fails if the job did not succeed.
pub async fn finish(client: &mut Client, status: &JobStatus, output: Output) -> Result<()> {
    output.result(status, || describe(status));
    if let Some(warning) = dark::warning(client, status).await {
        output.warn(warning);
    }
    for (doubtful, line) in verdicts::lines(client, status).await {
        match doubtful {
            true => output.warn(format!("warning: {line}")),
            false => output.say(line),
        }
    }
    verdict(status)
}
