//! `picofarm dataset import`: imports foreign data into a data set.

use std::{path::Path, sync::Arc, time::Instant};

use picofarm_dataset::{Dataset, Profile};
use picofarm_exchange::import::{ImportError, Source, import_scene};
use picofarm_results::Verdict;
use picofarm_store::published::Manifest as _;
use picofarm_store::{PROBE_WITHIN, open_store, probe};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use super::{failed, predictions::summed};
use crate::{
    args::DatasetImport,
    error::{CliError, Code, Result, io},
    files,
    output::{Meter, Output, bytes, duration},
    signals,
};

const HINT: &str = "run the same command again to go on; finished scenes are kept";

pub async fn run(args: DatasetImport, output: Output) -> Result<()> {
    let start = Instant::now();
    let stop = signals::stop_on_signal()?;
    let names = args.list.as_deref().map(names).transpose()?;
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| {
        CliError::new(
            Code::Resource,
            format!("cannot start {threads} threads: {e}"),
        )
    })?;
    let root = args.source.clone();
    let (format, options) = (args.format, args.options.options());
    let source = blocking(move || Source::open(&root, format, options, names.as_deref())).await?;
    let profile = Profile::parse(&args.profile)
        .map_err(|what| CliError::input(format!("--profile: {what}")))?;
    let spec = source.spec(profile);
    let (store, prefix) = open_store(&args.target).map_err(failed)?;
    probe(&*store, &prefix, PROBE_WITHIN)
        .await
        .map_err(failed)?;
    let dataset = Dataset::create_or_open(store, prefix, &spec)
        .await
        .map_err(failed)?;
    let work = Work {
        source: Arc::new(source),
        dataset,
        pool: Arc::new(pool),
        rehash: args.rehash,
    };
    let scenes = work.source.scenes();
    let (mut done, mut meter) = (Done::default(), Meter::new(output));
    for index in 0..scenes {
        let name = work.source.name(index).unwrap_or_default();
        let text = format!("{index} of {scenes} scenes, {}: {name}", bytes(done.read));
        meter.update(index as f64 / scenes as f64, text);
        if !work.one(index, &stop, &mut done, output).await? {
            return Err(signals::interrupted(HINT));
        }
    }
    meter.finish();
    let seconds = start.elapsed().as_secs_f64();
    let verdict = summed(done.verdicts.into_iter());
    let facts = json!({
        "source": args.source, "target": args.target, "format": work.source.format().name(), "scenes": scenes,
        "imported": done.imported, "found": done.found, "bytes_read": done.read, "bytes": done.written,
        "seconds": seconds, "verdict": verdict,
    });
    output.result(&facts, || {
        format!(
            "{}: {} scenes imported from {}, {} found finished; {} read, {} written in {}{}",
            args.target,
            done.imported,
            work.source.format().name(),
            done.found,
            bytes(done.read),
            bytes(done.written),
            duration(seconds),
            verdict
                .as_ref()
                .map_or_else(String::new, |v| format!("\n{}", v.text))
        )
    });
    Ok(())
}

#[derive(Default)]
struct Done {
    imported: u64,
    found: u64,
    read: u64,
    written: u64,
    /// Quantities reported as missing.
    named: Vec<&'static str>,
    /// Agreement of each scene's files, by scene.
    verdicts: Vec<(u64, Verdict)>,
}

struct Work {
    source: Arc<Source>,
    dataset: Dataset,
    pool: Arc<rayon::ThreadPool>,
    rehash: bool,
}

impl Work {
    /// Imports a scene unless it exists. Returns `false` if a signal arrived.
    async fn one(
        &self,
        index: u64,
        stop: &CancellationToken,
        done: &mut Done,
        output: Output,
    ) -> Result<bool> {
        if stop.is_cancelled() {
            return Ok(false);
        }
        let found = self
            .source
            .finished(&self.dataset, index, index, self.rehash)
            .await;
        if let Some(manifest) = found.map_err(refused)? {
            done.found += 1;
            done.written += manifest.total_bytes();
            return Ok(true);
        }
        let (source, pool) = (self.source.clone(), self.pool.clone());
        let scene = blocking(move || pool.install(|| import_scene(&source, index))).await?;
        if stop.is_cancelled() {
            return Ok(false);
        }
        let new: Vec<&str> = scene
            .missing
            .iter()
            .filter(|m| !done.named.contains(m))
            .copied()
            .collect();
        if !new.is_empty() {
            output.warn(format!(
                "warning: {}: not in the files, stored as zeros: {}",
                scene.name,
                new.join(", ")
            ));
            done.named.extend(scene.missing.iter());
        }
        done.verdicts
            .push((index, Verdict::of_import(&scene.check)));
        done.read += scene.files.iter().map(|f| f.bytes).sum::<u64>();
        let (source, pool, dataset) =
            (self.source.clone(), self.pool.clone(), self.dataset.clone());
        let encoded =
            blocking(move || pool.install(|| source.encode(&dataset, index, &scene))).await?;
        let manifest = tokio::select! {
            published = self.dataset.publish_encoded(encoded) => published.map_err(failed)?,
            () = stop.cancelled() => return Ok(false),
        };
        done.imported += 1;
        done.written += manifest.total_bytes();
        Ok(true)
    }
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> std::result::Result<T, ImportError> + Send + 'static,
) -> Result<T> {
    let joined = tokio::task::spawn_blocking(work).await;
    let result =
        joined.map_err(|e| CliError::new(Code::Failed, format!("importing broke: {e}")))?;
    result.map_err(refused)
}

fn refused(error: ImportError) -> CliError {
    match error {
        ImportError::Dataset(error) => failed(error),
        ImportError::Io { path, source, .. } => io(path, &source),
        other => CliError::input(other),
    }
}

/// Reads names of scenes, one per line. The paper's list has a header and contains names of
/// archives.
fn names(file: &Path) -> Result<Vec<String>> {
    let text = files::read_text(file, files::LISTS)?;
    let names = text
        .lines()
        .map(str::trim)
        .filter(|l| !l.is_empty() && !l.starts_with('#'));
    let names = names.map(|l| {
        l.split(".tar.gz")
            .next()
            .unwrap_or(l)
            .trim_end_matches('/')
            .to_owned()
    });
    Ok(names.collect())
}
