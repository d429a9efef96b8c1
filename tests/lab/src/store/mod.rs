//! `just lab store`: size, error and speed of each storage profile, on scenes of this
//! renderer, and how fast they are read again.

mod counting;
mod cpu;
mod reading;
mod report;
mod sample;
mod scenes;

use serde::Serialize;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use picofarm_dataset::{CodedImage, DatasetSpec, Profile, Subsets, TransientCodec, Wavelength};

use crate::args::Store as StoreArgs;
use picofarm_cli::{
    error::{CliError, Code, Result},
    output::{Meter, Output},
    settings::Settings,
    signals,
};

use reading::Reading;
use sample::{Loss, Sample};

/// Number of scenes of the whole data set.
const SCENES: f64 = 97_432.0;
/// Number of values of one of its scenes.
const VALUES: f64 = 256.0 * 256.0 * 637.0;
/// Number of times that each scene is encoded and decoded; the fastest counts.
const REPEATS: usize = 2;

/// Results of the benchmark.
#[derive(Debug, Serialize)]
struct Report {
    machine: Machine,
    scenes: Vec<Scene>,
    rows: Vec<Row>,
    reading: Option<Reading>,
}

#[derive(Debug, Serialize)]
struct Machine {
    processor: String,
    cores: usize,
    /// Whether this program is built with optimisation; otherwise times are meaningless.
    optimised: bool,
}

#[derive(Debug, Serialize)]
struct Scene {
    scene: u64,
    size: [usize; 3],
    photons_per_unit: f32,
    /// Fractions of bins without light, and with less than a photon.
    dark: f64,
    below_one_photon: f64,
    /// Mean number of bins of a pixel in which two-bounce light is expected.
    arrivals: f64,
}

/// One profile, over all scenes.
#[derive(Debug, Serialize)]
struct Row {
    name: &'static str,
    /// Megabytes a scene of 256×256×637, in proportion.
    mb_a_scene: f64,
    /// Size of 97,432 such scenes in terabytes.
    tb: f64,
    /// The maximum error, and root mean squares over all scenes.
    loss: Loss,
    encode_mb_per_cpu_s: f64,
    decode_mb_per_cpu_s: f64,
}

/// Runs the whole benchmark.
///
/// # Errors
/// Fails if scenes cannot be obtained, a codec fails, or on an interruption.
pub async fn run(
    args: StoreArgs,
    settings: &Settings,
    output: Output,
    stop: &CancellationToken,
) -> Result<()> {
    let scratch = tempfile::tempdir()
        .map_err(|e| CliError::new(Code::Resource, format!("a scratch folder: {e}")))?;
    let dir = args.keep.clone();
    let dir = dir.unwrap_or_else(|| scratch.path().join("farm"));
    let source = scenes::source(&args, &dir, settings, output, stop).await?;
    let samples = scenes::samples(&source, args.scenes).await?;
    let codecs = codecs(source.spec())?;
    let (stop, runtime) = (stop.clone(), Handle::current());
    let work = move || -> Result<Report> {
        let rows = rows(&codecs, &samples, output, &stop)?;
        let cores = picofarm_tasks::cores();
        let mut threads = vec![1, 2.min(cores), cores];
        threads.dedup();
        let reading = match args.no_reading {
            true => None,
            false => {
                output.say("reading …");
                let folder = scratch.path().join("read");
                let threads = &threads;
                Some(reading::measure(
                    &samples, &source, &folder, threads, &runtime, &stop,
                )?)
            }
        };
        Ok(Report {
            machine: machine(cores),
            scenes: samples.iter().map(scene).collect(),
            rows,
            reading,
        })
    };
    let done = tokio::task::spawn_blocking(work).await;
    let report =
        done.map_err(|e| CliError::new(Code::Failed, format!("the benchmark broke: {e}")))??;
    output.result(&report, || report::describe(&report));
    Ok(())
}

/// The profiles that keep h, by name, for images of the data set's size. `counts-u16` stores draws
/// of photons, which have no error of coding.
fn codecs(spec: &DatasetSpec) -> Result<Vec<(&'static str, TransientCodec)>> {
    let codec = |name| {
        let profile = Profile::parse(name).map_err(CliError::input)?;
        let spec = DatasetSpec {
            profile,
            per_spot: false,
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
            subsets: Subsets::NONE,
            ..*spec
        };
        let codec = TransientCodec::new(&spec).map_err(CliError::input)?;
        Ok((name, codec))
    };
    let names = Profile::NAMES.into_iter().filter(|n| *n != "counts-u16");
    names.map(codec).collect()
}

fn rows(
    codecs: &[(&'static str, TransientCodec)],
    samples: &[Sample],
    output: Output,
    stop: &CancellationToken,
) -> Result<Vec<Row>> {
    // One thread, so that its CPU time covers all work.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let pool =
        pool.map_err(|e| CliError::new(Code::Resource, format!("cannot start a thread: {e}")))?;
    let mut meter = Meter::new(output);
    let mut rows = Vec::new();
    for (at, (name, codec)) in codecs.iter().enumerate() {
        meter.update(at as f64 / codecs.len() as f64, (*name).into());
        let mut sums = Sums::default();
        for sample in samples {
            if stop.is_cancelled() {
                return Err(signals::interrupted("what was measured so far is lost"));
            }
            let one = pool.install(|| measure(codec, sample))?;
            sums.add(&one, &sample.loss(&one.decoded), sample);
        }
        rows.push(sums.row(name));
    }
    meter.finish();
    Ok(rows)
}

struct Measured {
    bytes: usize,
    encode_s: f64,
    decode_s: f64,
    decoded: Vec<f32>,
}

/// Codes and decodes one scene on this thread.
fn measure(codec: &TransientCodec, sample: &Sample) -> Result<Measured> {
    // Its pages are touched before the clock runs.
    let mut decoded = vec![f32::NAN; sample.h.len()];
    let (mut bytes, mut encode_s, mut decode_s) = (0, f64::INFINITY, f64::INFINITY);
    for _ in 0..REPEATS {
        let (coded, seconds) = cpu::of_thread(|| codec.encode(&sample.h, sample.scale));
        let coded = coded.map_err(CliError::input)?;
        encode_s = seconds.min(encode_s);
        bytes = size(&coded);
        let (done, seconds) = cpu::of_thread(|| codec.decode(&coded, &mut decoded));
        done.map_err(CliError::input)?;
        decode_s = seconds.min(decode_s);
    }
    Ok(Measured {
        bytes,
        encode_s,
        decode_s,
        decoded,
    })
}

/// Bytes of an image with its overflow list, whose entries are an index and a value.
fn size(coded: &CodedImage) -> usize {
    const ENTRY: usize = 12;
    coded.shard.len() + coded.overflow.len() * ENTRY
}

#[derive(Default)]
struct Sums {
    scenes: f64,
    bytes: f64,
    raw: f64,
    encode_s: f64,
    decode_s: f64,
    max: f64,
    squares: f64,
    moved: f64,
    peak_squares: f64,
}

impl Sums {
    fn add(&mut self, one: &Measured, loss: &Loss, sample: &Sample) {
        self.scenes += 1.0;
        self.bytes += one.bytes as f64;
        self.raw += sample.raw_bytes() as f64;
        self.encode_s += one.encode_s;
        self.decode_s += one.decode_s;
        self.max = self.max.max(loss.max_sigma);
        self.squares += loss.rms_sigma * loss.rms_sigma;
        self.moved += loss.peak_moved;
        self.peak_squares += loss.peak_sigma * loss.peak_sigma;
    }

    fn row(&self, name: &'static str) -> Row {
        let scene = self.bytes / self.raw * VALUES * 4.0;
        Row {
            name,
            mb_a_scene: scene / 1e6,
            tb: scene * SCENES / 1e12,
            loss: Loss {
                max_sigma: self.max,
                rms_sigma: (self.squares / self.scenes).sqrt(),
                peak_moved: self.moved / self.scenes,
                peak_sigma: (self.peak_squares / self.scenes).sqrt(),
            },
            encode_mb_per_cpu_s: self.raw / 1e6 / self.encode_s,
            decode_mb_per_cpu_s: self.raw / 1e6 / self.decode_s,
        }
    }
}

fn scene(sample: &Sample) -> Scene {
    let n = sample.h.len() as f64;
    let share = |photons: f32| {
        let below = sample.h.iter().filter(|h| **h * sample.scale <= photons);
        below.count() as f64 / n
    };
    Scene {
        scene: sample.scene,
        size: [sample.height, sample.width, sample.bins],
        photons_per_unit: sample.scale,
        dark: share(0.0),
        below_one_photon: share(1.0),
        arrivals: sample.arrivals(),
    }
}

fn machine(cores: usize) -> Machine {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = text.lines().find(|l| l.starts_with("model name"));
    let name = model
        .and_then(|l| l.split_once(':'))
        .map(|(_, name)| name.trim());
    Machine {
        processor: name.unwrap_or("unknown").to_owned(),
        cores,
        optimised: !cfg!(debug_assertions),
    }
}
