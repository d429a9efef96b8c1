//! `picofarm dataset repair`: makes broken scenes again on this machine and restores exactly their
//! broken objects.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use picofarm_dataset::{Dataset, Snapshot};
use picofarm_proto::spec::SourceSettings;
use picofarm_store::{Problem, VerifyMode};
use picofarm_tasks::{
    Control, TaskError,
    repair::{Hints, Repairer},
};
use serde_json::json;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use super::{
    failed, open,
    problems::{mode, problems_json},
    store_and_folder, task_failed,
    verify::{How, look},
};
use crate::{
    args::DatasetRepair,
    client::jobfile,
    error::{CliError, Code, Result},
    output::{Meter, Output, duration},
    settings::Settings,
    signals,
};

pub async fn run(args: DatasetRepair, settings: &Settings, output: Output) -> Result<()> {
    if super::predictions::find(&args.dataset).await?.is_some() {
        return Err(CliError::input(format!(
            "{}: holds what models predict, which a job makes again",
            args.dataset
        ))
        .hint(
            "submit the job that made it with `picofarm job submit FILE --from-stage STAGE`, with its infer stage: what is damaged \
             is predicted again, proved equal, and put back",
        ));
    }
    let start = Instant::now();
    let stop = signals::stop_on_signal()?;
    let (store, folder) = store_and_folder(&args.dataset)?;
    let hints = hints(&args, settings).await?;
    let repairer = Repairer::new(
        std::slice::from_ref(&settings.assets),
        Handle::current(),
        &store,
        &folder,
        hints,
    );
    let mut done = Done::default();
    let opened = match open(&args.dataset).await {
        Ok(dataset) if dataset.root_agrees().await.map_err(failed)? => Ok(dataset),
        Ok(_) => Err(CliError::new(
            Code::Damaged,
            format!("{}: zarr.json contradicts itself", args.dataset),
        )),
        Err(error) => Err(error),
    };
    let (dataset, repairer) = match opened {
        Ok(dataset) => (dataset, repairer),
        Err(error) if matches!(error.code, Code::Damaged | Code::Input) && !args.dry_run => {
            let restored = tokio::task::spawn_blocking(move || {
                let dataset = repairer.restore_root(&Control::default());
                dataset.map(|dataset| (dataset, repairer))
            })
            .await
            .map_err(|e| CliError::new(Code::Failed, format!("repairing broke: {e}")))?;
            done.written
                .push(format!("{}/zarr.json", args.dataset.trim_end_matches('/')));
            restored.map_err(task_failed)?
        }
        Err(error) => return Err(error),
    };
    let snapshot = match &args.snapshot {
        Some(name) => Some(dataset.snapshot(name).await.map_err(failed)?),
        None => None,
    };
    let how = How {
        fast: args.fast,
        complete: args.complete,
        snapshot: snapshot.as_ref(),
    };
    let report = tokio::select! {
        report = look(&dataset, &how, output) => report?,
        () = stop.cancelled() => return Err(signals::interrupted(AGAIN)),
    };
    let mut broken: BTreeMap<u64, Vec<Problem>> = BTreeMap::new();
    for problem in report.problems {
        match problem.scene {
            Some(scene) => broken.entry(scene).or_default().push(problem),
            None if problem.remedy().by_repair => done.metadata.push(problem),
            None => done.left.push(problem),
        }
    }
    if !done.metadata.is_empty() && !args.dry_run {
        let written = dataset.restore_metadata().await.map_err(failed)?;
        done.written.extend(written);
    }
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| {
        CliError::new(
            Code::Resource,
            format!("cannot start {threads} threads: {e}"),
        )
    })?;
    let work = Work {
        repairer,
        dataset,
        snapshot,
        dry: args.dry_run,
        mode: mode(args.fast),
        stop,
        runtime: Handle::current(),
    };
    let done = tokio::task::spawn_blocking(move || pool.install(|| work.all(broken, done, output)))
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("repairing broke: {e}")))??;
    tell(&args, &done, start.elapsed().as_secs_f64(), output)
}

const AGAIN: &str = "run the same command again to go on; repaired scenes stay repaired";

async fn hints(args: &DatasetRepair, settings: &Settings) -> Result<Hints> {
    let job = match &args.job {
        Some(file) => Some(jobfile::read_counted(file, None, &settings.assets).await?),
        None => None,
    };
    let source = args.source.as_deref().map(store_and_folder).transpose()?;
    let source = source.map(|(store, dataset)| SourceSettings { store, dataset });
    Ok(Hints {
        job,
        source,
        files: args.files.clone(),
    })
}

#[derive(Default)]
struct Done {
    /// Broken metadata.
    metadata: Vec<Problem>,
    /// Metadata that was rewritten.
    written: Vec<String>,
    /// Problems that this command cannot repair.
    left: Vec<Problem>,
    /// Scene, its problems, and the rewritten objects (with --dry-run: how it would be made).
    repaired: Vec<(u64, Vec<Problem>, Vec<String>)>,
    /// Scene, its problems, and the reason why they remain.
    failed: Vec<(u64, Vec<Problem>, String)>,
}

struct Work {
    repairer: Repairer,
    dataset: Dataset,
    snapshot: Option<Snapshot>,
    dry: bool,
    mode: VerifyMode,
    stop: CancellationToken,
    runtime: Handle,
}

impl Work {
    fn all(
        &self,
        broken: BTreeMap<u64, Vec<Problem>>,
        mut done: Done,
        output: Output,
    ) -> Result<Done> {
        let mut meter = Meter::new(output);
        let of = broken.len();
        for (at, (scene, problems)) in broken.into_iter().enumerate() {
            meter.update(
                at as f64 / of as f64,
                format!("{at} of {of} broken scenes, making scene {scene} again"),
            );
            match self.one(scene) {
                Ok(written) => done.repaired.push((scene, problems, written)),
                Err(TaskError::Stopped) => {
                    meter.finish();
                    return Err(signals::interrupted(AGAIN));
                }
                Err(error @ (TaskError::Interrupted(_) | TaskError::Store(_))) => {
                    return Err(task_failed(error));
                }
                Err(error) => done.failed.push((scene, problems, error.to_string())),
            }
        }
        meter.finish();
        Ok(done)
    }

    /// Repairs a scene and checks it again. Stops when a signal arrives.
    fn one(&self, scene: u64) -> std::result::Result<Vec<String>, TaskError> {
        let control = Arc::new(Control::default());
        if self.stop.is_cancelled() {
            return Err(TaskError::Stopped);
        }
        if self.dry {
            return Ok(vec![self.repairer.explain(scene, &control)?]);
        }
        let (stop, stopped) = (self.stop.clone(), control.clone());
        let watch = self.runtime.spawn(async move {
            stop.cancelled().await;
            stopped.stop();
        });
        let witness = self
            .snapshot
            .as_ref()
            .and_then(|s| s.manifest_sha256(scene));
        let result = self.repairer.run(scene, witness.as_deref(), &control);
        watch.abort();
        let restored = result?;
        let checked = self
            .runtime
            .block_on(self.dataset.verify_only(&[scene], self.mode));
        match checked {
            Ok(report) if report.is_sound() => Ok(restored.written),
            Ok(report) => Err(TaskError::Crash(format!(
                "it is still broken: {}",
                report.problems[0]
            ))),
            Err(error) => Err(TaskError::Interrupted(error.to_string())),
        }
    }
}

fn tell(args: &DatasetRepair, done: &Done, seconds: f64, output: Output) -> Result<()> {
    let repaired: Vec<_> = done
        .repaired
        .iter()
        .map(|(scene, problems, what)| match args.dry_run {
            true => json!({"scene": scene, "problems": problems_json(problems), "how": what}),
            false => json!({"scene": scene, "problems": problems_json(problems), "written": what}),
        })
        .collect();
    let failed: Vec<_> = done
        .failed
        .iter()
        .map(|(scene, problems, why)| {
            json!({"scene": scene, "problems": problems_json(problems), "why": why})
        })
        .collect();
    let facts = json!({
        "dataset": args.dataset, "dry_run": args.dry_run, "scenes": repaired, "metadata": done.written,
        "failed": failed, "left": problems_json(&done.left), "seconds": seconds,
    });
    output.result(&facts, || text(args, done, seconds));
    if done.failed.is_empty() && done.left.is_empty() {
        return Ok(());
    }
    let failed = done.failed.iter();
    let failed = failed.map(|(scene, _, why)| format!("scene {scene}: {why}"));
    let left = done
        .left
        .iter()
        .map(|p| format!("{p}: {}", p.remedy().text));
    let lines: Vec<String> = failed.chain(left).take(20).collect();
    Err(CliError::new(
        Code::Damaged,
        format!(
            "{}: {} problem(s) could not be repaired\n  {}",
            args.dataset,
            done.failed.len() + done.left.len(),
            lines.join("\n  ")
        ),
    ))
}

fn text(args: &DatasetRepair, done: &Done, seconds: f64) -> String {
    let mut text = String::new();
    for (scene, problems, what) in &done.repaired {
        let names: Vec<String> = problems.iter().map(ToString::to_string).collect();
        text += &format!("scene {scene}: {}\n", names.join("; "));
        let did = if args.dry_run {
            "would be"
        } else {
            "written again:"
        };
        text += &what
            .iter()
            .map(|w| format!("  {did} {w}\n"))
            .collect::<String>();
    }
    for problem in &done.metadata {
        text += &format!("{problem}\n");
    }
    text += &done
        .written
        .iter()
        .map(|w| format!("  written again: {w}\n"))
        .collect::<String>();
    text += &match (
        args.dry_run,
        done.repaired.len(),
        done.written.len() + done.metadata.len(),
    ) {
        (_, 0, 0) => match done.failed.is_empty() && done.left.is_empty() {
            true => format!("{}: nothing to repair", args.dataset),
            false => format!("{}: nothing repaired", args.dataset),
        },
        (true, n, _) => format!("{}: {n} scene(s) to make again", args.dataset),
        (false, n, m) => format!(
            "{}: {n} scene(s) made again and equal to what they were, {m} metadata object(s) repaired, in {}",
            args.dataset,
            duration(seconds)
        ),
    };
    text
}
