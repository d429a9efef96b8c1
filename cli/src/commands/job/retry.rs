//! `picofarm job retry`: dead tasks are pending again. A job names its scene files by their
//! content; where one was corrected since, a new job takes the old one's place and takes over the
//! scenes that are finished.

use picofarm_proto::{
    ids::JobId,
    messages::JobState,
    show,
    spec::{JobSpec, SceneKind},
};
use serde_json::json;

use super::submit;
use crate::{
    client::Client,
    error::{CliError, Result},
    output::Output,
};

/// Corrected files that are named.
const NAMED: usize = 3;

pub async fn run(client: &mut Client, job: JobId, output: Output) -> Result<()> {
    let status = client.status(job).await?;
    let goes_on = matches!(status.state, JobState::Active | JobState::Failed);
    if goes_on && status.tasks.dead > 0 && lists_files(&status.spec) {
        let mut spec = client.spec(job).await?;
        let changed = match repin(&mut spec) {
            Ok(changed) => changed,
            Err(why) => {
                output.warn(format!(
                    "warning: whether scene files were corrected is not known here: {why}\n  their tasks run again with the \
                     files as they were submitted; where one was corrected, retry on a machine that has it"
                ));
                Vec::new()
            }
        };
        if !changed.is_empty() {
            return instead(client, (job, status.state), spec, &changed, output).await;
        }
    }
    let retried = client.retry(job).await?;
    output.result(&json!({"job": job, "retried": retried}), || {
        format!("{retried} dead tasks of job {job} are pending again")
    });
    Ok(())
}

/// Submits a job with the files as they are now, for one that has ended with dead tasks.
async fn instead(
    client: &mut Client,
    (job, state): (JobId, JobState),
    spec: JobSpec,
    changed: &[String],
    output: Output,
) -> Result<()> {
    let mut named = changed[..changed.len().min(NAMED)].join(", ");
    if changed.len() > NAMED {
        named += &format!(" and {} more", changed.len() - NAMED);
    }
    let what = format!("{named}: changed since job {job} was submitted");
    if state == JobState::Active {
        let hint = format!("wait for its end (`picofarm job wait {job}`), and retry it then");
        return Err(CliError::input(format!("{what}, and that job still runs")).hint(hint));
    }
    let submitted = client.submit(spec, false).await?;
    output.say(format!(
        "{what}. Job {} takes its place, and takes over the scenes that are finished",
        submitted.job
    ));
    submit::answer(client, submitted, false, output).await
}

fn lists_files(spec: &JobSpec) -> bool {
    let mut scenes = spec.stages.iter().filter_map(|stage| stage.task.scenes());
    scenes.any(|scenes| matches!(scenes.kind, SceneKind::Files { .. }))
}

/// Pins the scene files of all stages by the content that they have now; those that had another
/// one, by field and path.
fn repin(spec: &mut JobSpec) -> std::result::Result<Vec<String>, String> {
    let mut changed = Vec::new();
    for stage in &mut spec.stages {
        let Some(scenes) = stage.task.scenes_mut() else {
            continue;
        };
        let positions = picofarm_tasks::repin(scenes).map_err(|e| e.to_string())?;
        if positions.is_empty() {
            continue;
        }
        // Finished scenes are taken over. They are not rendered again for a comparison.
        stage.force = false;
        for at in positions {
            let path = scenes.kind.file(at as u64).map_or("", |file| &*file.path);
            let named = format!("scenes.files[{at}] {}", show::line(path));
            if !changed.contains(&named) {
                changed.push(named);
            }
        }
    }
    Ok(changed)
}
