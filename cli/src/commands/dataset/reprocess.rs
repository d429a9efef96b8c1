//! `picofarm dataset reprocess`: passes every scene of a data set through a sensor, on this
//! machine.

use std::{sync::Arc, time::Instant};

use picofarm_proto::spec::{
    OutputSettings, ReprocessSettings, ReprocessTask, SourceSettings, TaskKind,
};
use picofarm_tasks::{
    Control, TaskError,
    reprocess::{Reprocessor, sensor_version},
};
use serde_json::json;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use super::{store_and_folder, task_failed};
use crate::{
    args::DatasetReprocess,
    commands::scene::sensor,
    error::{CliError, Code, Result},
    output::{Meter, Output, bytes, duration},
    signals,
};

pub async fn run(args: DatasetReprocess, output: Output) -> Result<()> {
    let task = task(&args)?;
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            CliError::new(
                Code::Resource,
                format!("cannot start {threads} threads: {e}"),
            )
        })?;
    let work = Work {
        reprocessor: Reprocessor::new(Handle::current()),
        task,
        stop: signals::stop_on_signal()?,
        runtime: Handle::current(),
    };
    let start = Instant::now();
    let done = tokio::task::spawn_blocking(move || pool.install(|| work.all(output)))
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("reprocessing broke: {e}")))??;
    let seconds = start.elapsed().as_secs_f64();
    let facts = json!({
        "source": args.source, "target": args.target, "scenes": done.computed + done.adopted,
        "computed": done.computed, "adopted": done.adopted, "missing": done.missing,
        "bytes": done.bytes, "seconds": seconds,
    });
    output.result(&facts, || {
        let mut text = format!(
            "{}: {} scenes measured, {} found finished, {} in {}",
            args.target,
            done.computed,
            done.adopted,
            bytes(done.bytes),
            duration(seconds)
        );
        if done.missing > 0 {
            text += &format!(
                "; {} scenes are not in {} yet: run the same command again once they are",
                done.missing, args.source
            );
        }
        text
    });
    Ok(())
}

/// Returns the task for the arguments, with all inputs of its key filled in.
fn task(args: &DatasetReprocess) -> Result<ReprocessTask> {
    let (store, dataset) = store_and_folder(&args.source)?;
    let source = SourceSettings { store, dataset };
    let mut settings = ReprocessSettings {
        histogram: args.histogram,
        spots: args.spots.clone(),
        sensor: sensor::settings(&args.sensor)?,
        drop_left_over: args.drop_left_over,
        on_counts: args.on_counts,
        seed: args.seed,
        version: sensor_version(),
    };
    settings.normalise();
    let profile = args.profile.clone();
    let profile = profile.unwrap_or_else(|| settings.natural_profile().to_owned());
    let (store, dataset) = store_and_folder(&args.target)?;
    let output = OutputSettings {
        store,
        dataset,
        profile,
    };
    let task = ReprocessTask {
        source,
        // Placeholder for the number of scenes, which is unknown here.
        count: 1,
        reprocess: settings,
        output,
    };
    task.check()?;
    Ok(task)
}

struct Work {
    reprocessor: Reprocessor,
    task: ReprocessTask,
    stop: CancellationToken,
    runtime: Handle,
}

#[derive(Default)]
struct Done {
    computed: u64,
    adopted: u64,
    missing: u64,
    bytes: u64,
}

impl Work {
    fn all(&self, output: Output) -> Result<Done> {
        let (scenes, room) = self
            .reprocessor
            .source(&self.task.source, &Control::default())
            .map_err(task_failed)?;
        if scenes.is_empty() {
            return Err(CliError::input(format!(
                "{}: no scene is published yet",
                self.task.source.dataset
            )));
        }
        let mut done = Done {
            missing: room - scenes.len() as u64,
            ..Done::default()
        };
        let mut meter = Meter::new(output);
        for (at, scene) in scenes.iter().enumerate() {
            let text = format!("{at} of {} scenes, {}", scenes.len(), bytes(done.bytes));
            meter.update(at as f64 / scenes.len() as f64, text);
            let result = self.one(*scene).map_err(task_failed)?;
            done.bytes += result.bytes;
            match result.adopted {
                true => done.adopted += 1,
                false => done.computed += 1,
            }
        }
        meter.finish();
        Ok(done)
    }

    /// Reprocesses one scene. Stops when a signal arrives.
    fn one(&self, scene: u64) -> Result<picofarm_tasks::Output, TaskError> {
        let control = Arc::new(Control::default());
        let (stop, stopped) = (self.stop.clone(), control.clone());
        let watch = self.runtime.spawn(async move {
            stop.cancelled().await;
            stopped.stop();
        });
        if self.stop.is_cancelled() {
            return Err(TaskError::Stopped);
        }
        let result = self.reprocessor.run(&self.task, scene, &control);
        watch.abort();
        result
    }
}
