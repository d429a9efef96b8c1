//! The arguments of commands that make data of data: `scene sense`, `dataset reprocess`, `dataset split`,
//! `dataset export`.

use std::path::PathBuf;

use clap::Args;
use picofarm_proto::model::Histogram;

use picofarm_agent::export::Scenes;

/// A sensor.
#[derive(Args, Clone, Default)]
pub struct SensorArgs {
    /// Sensor settings (TOML); the options below go before them
    #[arg(long, value_name = "FILE")]
    pub sensor: Option<PathBuf>,
    /// Photons in the two-bounce peak of the median pixel: a number, or a range to draw it from [default: 10..400]
    #[arg(long, value_name = "LOW..HIGH")]
    pub peak_photons: Option<String>,
    /// Photons for a unit of the transient, instead of a peak
    #[arg(long, value_name = "N", conflicts_with = "peak_photons")]
    pub photons_per_unit: Option<f64>,
    /// Pulse: fwhm:PS (Gaussian rise, exponential tail) or none; measured pulses go into --sensor [default: fwhm:128]
    #[arg(long, value_name = "PULSE")]
    pub pulse: Option<String>,
    /// Timing jitter, full width at half maximum in picoseconds [default: 50]
    #[arg(long, value_name = "PS")]
    pub jitter_ps: Option<f64>,
    /// Jitter as in the published code: the pulse is shifted by floor(N(0, 2.654)) bins, once a scene
    #[arg(long, conflicts_with = "jitter_ps")]
    pub jitter_sb3d: bool,
    /// Ambient and dark counts, photons a bin (before --rebin) [default: 0]
    #[arg(long, value_name = "RATE")]
    pub dark: Option<f64>,
    /// Sum this many adjacent bins [default: 1]
    #[arg(long, value_name = "BINS")]
    pub rebin: Option<u32>,
    /// Write the expected photons instead of drawing counts
    #[arg(long)]
    pub no_poisson: bool,
    /// Pile-up: at most one photon a pixel and pulse is seen, of so many pulses [default: all photons are]
    #[arg(long, value_name = "pulses:N")]
    pub dead_time: Option<String>,
}

#[derive(Args)]
pub struct DatasetReprocess {
    /// Folder or URL of the data set to read
    pub source: String,
    /// Folder or URL of the data set to make, or to go on with
    pub target: String,
    /// Which histogram: transient, transient_4, transient_25, or transient_spots with --spots
    #[arg(long, default_value = "transient", value_name = "NAME", value_parser = Histogram::parse)]
    pub histogram: Histogram,
    /// Sum the histograms of these spots (counted from 0); needs --histogram transient_spots
    #[arg(long, value_delimiter = ',', value_name = "SPOT,…")]
    pub spots: Vec<u32>,
    #[command(flatten)]
    pub sensor: SensorArgs,
    /// Drop the bins that --rebin leaves over at the end of the gate; otherwise it must divide the bins
    #[arg(long)]
    pub drop_left_over: bool,
    /// Codec: counts-u16, sqrt-u16 or plain-f32 [default: counts-u16, with --no-poisson sqrt-u16]
    #[arg(long, value_name = "NAME")]
    pub profile: Option<String>,
    /// Chooses another draw of the same noise
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Threads [default: all cores]
    #[arg(long)]
    pub threads: Option<usize>,
}

#[derive(Args)]
pub struct DatasetSplit {
    /// Folder or URL of the data set
    pub dataset: String,
    /// Name of the split
    #[arg(long, default_value = "default")]
    pub name: String,
    /// Scenes for training, validation and test, together all there are, e.g. 87688,3744,6000
    #[arg(long, value_name = "N,N,N", value_parser = three::<u64>, required_unless_present_any = ["fractions", "show"])]
    pub counts: Option<[u64; 3]>,
    /// Shares for training, validation and test, e.g. 0.9,0.04,0.06
    #[arg(long, value_name = "F,F,F", value_parser = three::<f64>, conflicts_with = "counts")]
    pub fractions: Option<[f64; 3]>,
    /// Seed of the hash that orders the scenes
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Only show the newest version
    #[arg(long, conflicts_with_all = ["counts", "fractions", "seed"])]
    pub show: bool,
}

#[derive(Args)]
pub struct DatasetExport {
    /// Folder or URL of the data set
    pub dataset: String,
    /// Folder or URL for the export
    pub dest: String,
    /// Which scenes: A..B, split:train, split:validation, split:test or split:NAME:SIDE [default: all]
    #[arg(long, value_name = "SCENES", value_parser = Scenes::parse)]
    pub scenes: Option<Scenes>,
}

fn three<T: std::str::FromStr>(text: &str) -> Result<[T; 3], String> {
    let expected = || "expected three numbers: training,validation,test".to_owned();
    let number = |part: &str| part.trim().parse().map_err(|_| expected());
    let all = text.split(',').map(number).collect::<Result<Vec<T>, _>>()?;
    all.try_into().map_err(|_| expected())
}
