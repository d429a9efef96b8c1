//! `picofarm job …`.

mod check;
mod dark;
mod explain;
mod finish;
mod list;
mod retry;
mod status;
mod submit;
pub(crate) mod template;
mod verdicts;

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use clap::ValueEnum;
use picofarm_proto::{ids::JobId, messages::Event, show, spec::JobSpec};
use serde_json::json;

use finish::finish;

use crate::{
    args::{Job, JobKind},
    client::{
        Client, Listing, Page,
        follow::{Show, follow},
        jobfile,
        stores::{self, Identity},
    },
    commands::events,
    error::{CliError, Code, Result, io},
    output::{
        Output,
        describe::{describe, describe_event, describe_plan},
    },
    settings::Settings,
};

pub async fn run(command: Job, settings: &Settings, output: Output) -> Result<()> {
    match &command {
        Job::Init { file, kind } => return init(file.as_deref(), *kind, output),
        Job::Check { file, scale } => {
            let spec = jobfile::read_counted(file, scale.as_deref(), &settings.assets).await?;
            check::show(file, &spec, output);
            return Ok(());
        }
        _ => {}
    }
    let mut spec = match &command {
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
    if let Some(spec) = &mut spec {
        stores::warn_of_stores(spec, output).await;
        let submits = matches!(
            command,
            Job::Submit {
                only_failed: false,
                ..
            }
        );
        let identity = match submits {
            true => Identity::Create,
            false => Identity::Read,
        };
        stores::identify(spec, identity, output).await;
    }
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    if let Some(spec) = &mut spec {
        name_former_jobs(spec, &mut client).await?;
    }
    match command {
        Job::Init { .. } | Job::Check { .. } => Ok(()),
        Job::Plan { .. } => {
            let spec = spec.expect("read above");
            let mut plan = client.plan(spec.clone()).await?;
            let twin = submit::twin(&mut client, &plan).await;
            let notes = stores::there(&spec, &mut plan).await;
            output.result(&plan, || describe_plan(&plan) + &twin);
            for line in notes {
                output.warn(format!("note: {line}"));
            }
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
                    finish(&mut client, &status, output).await
                }
                false => Ok(()),
            }
        }
        Job::Submit { watch, again, .. } => {
            let submitted = client.submit(spec.expect("read above"), again).await?;
            submit::answer(&mut client, submitted, watch, output).await
        }
        Job::List {
            limit,
            page,
            state,
            user,
        } => {
            let ask = Listing {
                limit,
                page: page.as_deref(),
                state: state.map(Into::into),
                user: user.as_deref(),
                find: None,
            };
            list::run(&mut client, &ask, output).await
        }
        Job::Status { job } => {
            let job = client.find(&job).await?;
            status::run(&mut client, job, output).await
        }
        Job::Watch { job } => {
            let job = client.find(&job).await?;
            let status = follow(&mut client, job, output, Show::Progress).await?;
            finish(&mut client, &status, output).await
        }
        Job::Wait { job, timeout_s } => {
            let job = client.find(&job).await?;
            let ended = follow(&mut client, job, output, Show::Nothing);
            let status = match timeout_s {
                None => ended.await?,
                Some(s) => tokio::time::timeout(Duration::from_secs_f64(s), ended)
                    .await
                    .map_err(|_| {
                        CliError::new(Code::Failed, format!("job {job} has not ended in {s} s"))
                            .hint(format!("see `picofarm job status {job}`"))
                    })??,
            };
            finish(&mut client, &status, output).await
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
            retry::run(&mut client, job, output).await
        }
        Job::Explain { job, stage, task } => {
            let job = client.find(&job).await?;
            let stage = position(&mut client, job, stage.as_deref()).await?;
            let explained = client.explain(job, stage.unwrap_or(0), task).await?;
            let dark = dark::warning(&mut client, &explained.job).await;
            output.result(&explained, || explain::describe(&explained));
            if let Some(warning) = dark {
                output.warn(warning);
            }
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
                return events::follow(client, page, output).await;
            }
            let events = history(&mut client, page).await?;
            output.result(&events, || events.iter().map(describe_event).collect());
            Ok(())
        }
    }
}

fn init(file: Option<&Path>, kind: Option<JobKind>, output: Output) -> Result<()> {
    use std::io::Write;
    let name = kind.and_then(|kind| Some(kind.to_possible_value()?.get_name().to_owned()));
    let usual = PathBuf::from(format!("{}.toml", name.as_deref().unwrap_or("job")));
    let file = file.unwrap_or(&usual);
    let kind = kind.unwrap_or(JobKind::Furnished);
    std::fs::File::create_new(file)
        .and_then(|mut f| f.write_all(crate::commands::job::template::template(kind).as_bytes()))
        .map_err(|e| match e.kind() {
            std::io::ErrorKind::AlreadyExists => {
                let kind = name.map_or_else(String::new, |name| format!(" --kind {name}"));
                CliError::input(format!("{} exists and is left as it is", file.display())).hint(
                    format!(
                        "name another file: picofarm job init {}{kind}",
                        show::path(&other(file))
                    ),
                )
            }
            _ => io(file.display(), &e),
        })?;
    output.result(&json!({"file": file}), || {
        format!(
            "wrote {}; next: picofarm job plan {}",
            show::line(&file.display().to_string()),
            show::path(file)
        )
    });
    Ok(())
}

/// Returns an unused file name next to `file`: `job-2.toml` for `job.toml`.
fn other(file: &Path) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let end = file
        .extension()
        .map_or_else(String::new, |e| format!(".{}", e.to_string_lossy()));
    let names = (2..).map(|n| file.with_file_name(format!("{stem}-{n}{end}")));
    { names }
        .find(|path| !path.exists())
        .expect("numbers do not end")
}

/// Marks the stages selected by `--force` and `--from-stage`. The marks make the job distinct from
/// the same job without them, which would already exist.
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

/// Returns the position of a stage given by name or position.
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

/// Returns the last events, in order.
async fn history(client: &mut Client, page: Page) -> Result<Vec<Event>> {
    // The coordinator may return a shorter page than requested. This reads forward and retains the
    // last events.
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

/// Replaces the numbers and names of the jobs in `after` by their ids.
async fn name_former_jobs(spec: &mut JobSpec, client: &mut Client) -> Result<()> {
    for name in &mut spec.after {
        let found = client.find(name).await.map_err(|e| CliError {
            message: format!("after: {}", e.message),
            ..e
        });
        *name = found?.to_string();
    }
    Ok(())
}
