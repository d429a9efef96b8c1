//! Measures how fast scenes are read through the data set's own reader, and how much is fetched for
//! a part of a scene.

use std::{
    path::Path,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
        mpsc,
    },
    time::{Duration, Instant},
};

use picofarm_dataset::{Dataset, DatasetSpec, Profile, Provenance, Quantity, Subsets, Wavelength};
use picofarm_model::{
    input::{Normalise, planes_of},
    scene::{Order, Scene},
};
use picofarm_store::{StorageError, open_store};
use serde::Serialize;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use super::{counting::Counting, cpu, sample::Sample};
use picofarm_cli::{
    error::{CliError, Code, Result},
    signals,
};

/// Scenes per second that eight GPUs consume: 200 epochs of 87,688 scenes in two days.
pub const TRAINING: f64 = 101.0;
/// Width and height of a crop.
const CROP: u32 = 64;
/// Number of reads per measurement.
const READS: usize = 12;
/// Number of reads of a reader before the first measured one, after which both of its buffers
/// exist.
const FIRST: usize = 2;

/// Results of the measurement.
#[derive(Debug, Serialize)]
pub struct Reading {
    pub profile: String,
    /// Decoded 32-bit floats per CPU second, in megabytes, for whole scenes.
    pub whole_mb_per_cpu_s: f64,
    /// The same with a reused buffer.
    pub reused_mb_per_cpu_s: f64,
    pub crop: Crop,
    /// 128 bins of all pixels.
    pub bins: Fetched,
    pub loaders: Vec<Loader>,
}

/// Crops at several positions.
#[derive(Debug, Serialize)]
pub struct Crop {
    pub side: u32,
    /// Aligned with the edges of the inner chunks.
    pub aligned: Fetched,
    /// Mean over crops at all offsets that are multiples of 16 pixels.
    pub mean: Fetched,
    /// Maximum over these crops.
    pub worst: Fetched,
}

/// Data fetched by a read.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Fetched {
    /// Bytes of the transient's object, including its index but not the manifest, which every read
    /// fetches.
    pub bytes: f64,
    /// Bytes relative to the part's share of the object.
    pub of_share: f64,
    pub requests: f64,
}

/// Result of loading a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Into {
    /// Its histogram, in a buffer of the thread.
    Histogram,
    /// Its share of a network's batch: scaled images of bins, in newly allocated memory.
    Input,
}

/// Several concurrent readers, as in a training's loader, each with a thread of its own.
#[derive(Debug, Serialize)]
pub struct Loader {
    /// Result of loading each scene.
    pub into: Into,
    pub threads: usize,
    pub scenes_per_s: f64,
    pub cpu_s_a_scene: f64,
    /// Number of cores that decode [`TRAINING`] scenes per second, by CPU time.
    pub cores_for_training: f64,
}

/// Measures reading of scenes of `spec`'s size, encoded with the default profile, in `folder`.
///
/// # Errors
/// Fails if the folder cannot be written, or on an interruption.
pub fn measure(
    samples: &[Sample],
    source: &Dataset,
    folder: &Path,
    threads: &[usize],
    runtime: &tokio::runtime::Handle,
    stop: &CancellationToken,
) -> Result<Reading> {
    let dataset = runtime
        .block_on(written(samples, source, folder))
        .map_err(failed)?;
    let single = pool(1)?;
    let scene = |i: usize| (i % samples.len()) as u64;
    let mut buffer = Vec::new();
    // The first reads bring the files into memory.
    let mut whole = 0.0;
    let mut reused = 0.0;
    for i in 0..samples.len() + READS {
        stopped(stop)?;
        let once = || runtime.block_on(dataset.read_transient(scene(i)));
        let (read, fresh) = cpu::of_process(|| single.install(once));
        drop(read.map_err(failed)?);
        let into = || {
            let into = dataset.read_histogram_into(scene(i), Quantity::Transient, &mut buffer);
            runtime.block_on(into)
        };
        let (read, again) = cpu::of_process(|| single.install(into));
        read.map_err(failed)?;
        if i >= samples.len() {
            whole += fresh;
            reused += again;
        }
    }
    let megabytes = samples[0].raw_bytes() as f64 * READS as f64 / 1e6;
    let (crop, bins) = runtime
        .block_on(fetched(source.spec(), folder))
        .map_err(failed)?;
    let mut loaders = Vec::new();
    for threads in threads {
        stopped(stop)?;
        for into in [Into::Histogram, Into::Input] {
            loaders.push(loader(&dataset, samples.len(), (*threads, into), runtime)?);
        }
    }
    Ok(Reading {
        profile: Profile::default().to_string(),
        whole_mb_per_cpu_s: megabytes / whole,
        reused_mb_per_cpu_s: megabytes / reused,
        crop,
        bins,
        loaders,
    })
}

fn stopped(stop: &CancellationToken) -> Result<()> {
    match stop.is_cancelled() {
        true => Err(signals::interrupted("what was measured so far is lost")),
        false => Ok(()),
    }
}

fn failed(e: StorageError) -> CliError {
    CliError::new(Code::Failed, e.to_string())
}

fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map_err(|e| {
        CliError::new(
            Code::Resource,
            format!("cannot start {threads} threads: {e}"),
        )
    })
}

/// Writes a data set of the samples in the default profile.
async fn written(
    samples: &[Sample],
    source: &Dataset,
    folder: &Path,
) -> Result<Dataset, StorageError> {
    let spec = DatasetSpec {
        scenes: samples.len() as u64,
        profile: Profile::default(),
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        ..*source.spec()
    };
    let (store, prefix) = open_store(&folder.display().to_string())?;
    let dataset = Dataset::create_or_open(store, prefix, &spec).await?;
    let provenance = Provenance {
        task_key: "bench".into(),
        renderer: "bench".into(),
        seed: 0,
        plan: json!({}),
    };
    for (i, sample) in samples.iter().enumerate() {
        let truth = source.read_truth(sample.scene).await?;
        let coded =
            dataset.encode_derived(i as u64, &truth, &sample.h, sample.scale, &provenance)?;
        dataset.publish_encoded(coded).await?;
    }
    Ok(dataset)
}

async fn fetched(spec: &DatasetSpec, folder: &Path) -> Result<(Crop, Fetched), StorageError> {
    let (store, prefix) = open_store(&folder.display().to_string())?;
    let counting = Arc::new(Counting::new(store));
    let dataset = Dataset::open(counting.clone(), prefix).await?;
    counting.take();
    let manifest = dataset.manifest(0).await?;
    let (manifest_bytes, _) = counting.take();
    let object = manifest.objects[0].size as f64;
    let values = spec.transient_len() as f64;
    let of = |part: f64| {
        let (bytes, requests) = counting.take();
        let bytes = (bytes - manifest_bytes) as f64;
        Fetched {
            bytes,
            of_share: bytes / (object * part / values),
            requests: requests as f64 - 1.0,
        }
    };
    let bins = spec.gate.bins;
    let side = CROP.min(spec.height).min(spec.width);
    let crop_values = f64::from(side * side) * f64::from(bins);
    let (mut worst, mut sum, mut n) = (Fetched::default(), Fetched::default(), 0.0);
    let mut aligned = Fetched::default();
    for top in (0..=spec.height - side).step_by(16) {
        for left in (0..=spec.width - side).step_by(16) {
            let crop = dataset.read_transient_crop(0, top..top + side, left..left + side);
            crop.await?;
            let found = of(crop_values);
            if (top, left) == (0, 0) {
                aligned = found;
            }
            if found.of_share > worst.of_share {
                worst = found;
            }
            sum.bytes += found.bytes;
            sum.of_share += found.of_share;
            sum.requests += found.requests;
            n += 1.0;
        }
    }
    let mean = Fetched {
        bytes: sum.bytes / n,
        of_share: sum.of_share / n,
        requests: sum.requests / n,
    };
    let first = bins.saturating_sub(1) / 256 * 128;
    let few = first..(first + 128).min(bins);
    let share = spec.pixels() as f64 * few.len() as f64;
    let part = dataset.read_transient_part(0, 0..spec.height, 0..spec.width, few);
    part.await?;
    let crop = Crop {
        side,
        aligned,
        mean,
        worst,
    };
    Ok((crop, of(share)))
}

/// Measures `threads` readers that share the scenes in turn. The first reads of each are not
/// measured, because they allocate memory that later reads reuse.
fn loader(
    dataset: &Dataset,
    scenes: usize,
    (threads, into): (usize, Into),
    runtime: &tokio::runtime::Handle,
) -> Result<Loader> {
    let pools = (0..threads).map(|_| pool(1)).collect::<Result<Vec<_>>>()?;
    let next = AtomicUsize::new(0);
    let total = READS * threads;
    let begin = Mutex::new(());
    let one = |pool: &rayon::ThreadPool, ready: mpsc::Sender<()>| -> Result<(), StorageError> {
        let (mut buffer, mut scaled) = (Vec::new(), Vec::new());
        let mut read = |i: usize| -> Result<(), StorageError> {
            let scene = (i % scenes) as u64;
            match into {
                Into::Histogram => {
                    let read = dataset.read_histogram_into(scene, Quantity::Transient, &mut buffer);
                    pool.install(|| runtime.block_on(read))?;
                }
                Into::Input => {
                    let read = dataset.read_planes_into(scene, Quantity::Transient, &mut buffer);
                    pool.install(|| runtime.block_on(read))?;
                    let mut seen = seen(dataset.spec(), std::mem::take(&mut buffer));
                    let bins = seen.bins;
                    planes_of(&mut seen, bins, Normalise::MinMax, &mut scaled);
                    buffer = seen.histogram;
                    // Stands for joining the batch.
                    drop(std::hint::black_box(scaled.clone()));
                }
            }
            Ok(())
        };
        (0..FIRST).try_for_each(&mut read)?;
        drop(ready);
        drop(begin.lock().unwrap_or_else(PoisonError::into_inner));
        loop {
            match next.fetch_add(1, Ordering::Relaxed) {
                i if i < total => read(i)?,
                _ => return Ok(()),
            }
        }
    };
    let (results, cpu_s, seconds) = std::thread::scope(|scope| {
        let held = begin.lock().unwrap_or_else(PoisonError::into_inner);
        let (ready, all_ready) = mpsc::channel();
        let one = &one;
        let reader = |pool| {
            let ready = ready.clone();
            scope.spawn(move || one(pool, ready))
        };
        let readers: Vec<_> = pools.iter().map(reader).collect();
        drop(ready);
        // Nothing is ever sent: the call returns once every reader is ready, or has ended.
        let _ = all_ready.recv();
        drop(held);
        let start = Instant::now();
        let join = |r: std::thread::ScopedJoinHandle<'_, Result<(), StorageError>>| r.join();
        let all = || readers.into_iter().map(join).collect::<Vec<_>>();
        let (results, cpu_s) = cpu::of_process(all);
        let took = start.elapsed().max(Duration::from_millis(1));
        (results, cpu_s, took.as_secs_f64())
    });
    for result in results {
        result
            .map_err(|_| CliError::new(Code::Failed, "a reader of the benchmark broke"))?
            .map_err(failed)?;
    }
    let cpu_s_a_scene = cpu_s / total as f64;
    Ok(Loader {
        into,
        threads,
        scenes_per_s: total as f64 / seconds,
        cpu_s_a_scene,
        cores_for_training: TRAINING * cpu_s_a_scene,
    })
}

/// Returns a scene with only the histogram h, `[bin][row][column]`.
fn seen(spec: &DatasetSpec, h: Vec<f32>) -> Scene {
    Scene {
        height: spec.height as usize,
        width: spec.width as usize,
        bins: spec.gate.bins as usize,
        histogram: h,
        order: Order::Bins,
        ..Scene::default()
    }
}
