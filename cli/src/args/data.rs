//! Arguments of commands that derive data from other data: `scene sense`, `dataset reprocess`,
//! `dataset split`, `dataset export`, `dataset import`.

use std::path::PathBuf;

use clap::{Args, ValueEnum, builder::PossibleValue};
use picofarm_proto::spec::Histogram;

use picofarm_exchange::ExportFormat;
use picofarm_exchange::import::{Captures, DepthKind, Format, ImportOptions, Polarity};
use picofarm_sensor::Preset;
use picofarm_tasks::export::Scenes;

/// A sensor.
#[derive(Args, Clone, Default)]
pub struct SensorArgs {
    /// Sensor settings (TOML); the options below override them
    #[arg(long, value_name = "FILE")]
    pub sensor: Option<PathBuf>,
    /// Settings of a sensor that one can buy; the options below override them
    #[arg(long, value_name = "NAME", conflicts_with = "sensor")]
    pub preset: Option<PresetArg>,
    /// Photons in the two-bounce peak of the median pixel: a number, or a range to draw from
    /// [default: 10..400]
    #[arg(long, value_name = "LOW..HIGH")]
    pub peak_photons: Option<String>,
    /// Photons per unit of the transient, instead of a peak
    #[arg(long, value_name = "N", conflicts_with = "peak_photons")]
    pub photons_per_unit: Option<f64>,
    /// Pulse: fwhm:PS (Gaussian rise, exponential tail), none, or file:PATH, a table (CSV) of the
    /// time in picoseconds and the energy, with equal steps; light arrives at time 0 [default:
    /// fwhm:128]
    #[arg(long, value_name = "PULSE")]
    pub pulse: Option<String>,
    /// Timing jitter, full width at half maximum in picoseconds [default: 50]
    #[arg(long, value_name = "PS")]
    pub jitter_ps: Option<f64>,
    /// Jitter as in Shoot-Bounce-3D's code: each scene is shifted by floor(N(0, 2.654)) bins
    #[arg(long, conflicts_with = "jitter_ps")]
    pub jitter_sb3d: bool,
    /// Ambient and dark counts, photons per bin before --rebin [default: 0]
    #[arg(long, value_name = "RATE")]
    pub dark: Option<f64>,
    /// Sum this many adjacent bins [default: 1]
    #[arg(long, value_name = "BINS")]
    pub rebin: Option<u32>,
    /// Write the expected photons instead of drawing counts
    #[arg(long)]
    pub no_poisson: bool,
    /// Pile-up: pulses:N, of which a pixel detects at most one photon each, or
    /// free:N,DEAD,PERIOD, a free-running pixel with a dead time and pulses a period apart, in
    /// picoseconds [default: all photons are detected]
    #[arg(long, value_name = "KIND:…")]
    pub dead_time: Option<String>,
    /// Wide pixels: the mean over the image's part of each zone
    #[arg(long, value_name = "ROWSxCOLUMNS")]
    pub zones: Option<String>,
    /// Bins of the detector: the start after the laser's pulse, the width of a bin, both in
    /// picoseconds, and the number of bins [default: those of the render]
    #[arg(long, value_name = "START,WIDTH,BINS", allow_hyphen_values = true)]
    pub gate: Option<String>,
    /// Crosstalk: probability that a count triggers the pixel above, below, left or right
    #[arg(long, value_name = "P")]
    pub crosstalk: Option<f64>,
    /// Afterpulsing: probability, and time constant in picoseconds
    #[arg(long, value_name = "P,DECAY")]
    pub afterpulsing: Option<String>,
}

/// A sensor of a data sheet.
#[derive(Debug, Clone, Copy)]
pub struct PresetArg(pub Preset);

impl ValueEnum for PresetArg {
    fn value_variants<'a>() -> &'a [Self] {
        const ALL: [PresetArg; 3] = [
            PresetArg(Preset::ALL[0]),
            PresetArg(Preset::ALL[1]),
            PresetArg(Preset::ALL[2]),
        ];
        &ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let preset = self.0;
        let help = format!(
            "{}, view {}. From {}. Assumed: {}",
            preset.device(),
            preset.view(),
            preset.source(),
            preset.assumed()
        );
        Some(PossibleValue::new(preset.name()).help(help))
    }
}

#[derive(Args)]
pub struct DatasetReprocess {
    /// Folder or URL of the data set to read
    #[arg(value_parser = crate::args::location::parse)]
    pub source: String,
    /// Folder or URL of the data set to write or continue
    #[arg(value_parser = crate::args::location::parse)]
    pub target: String,
    /// Histogram: transient, transient_4, transient_25, or transient_spots with --spots
    #[arg(long, default_value = "transient", value_name = "NAME", value_parser = Histogram::parse)]
    pub histogram: Histogram,
    /// Sum the histograms of these spots (counted from 0); needs --histogram transient_spots
    #[arg(long, value_delimiter = ',', value_name = "SPOT,…")]
    pub spots: Vec<u32>,
    #[command(flatten)]
    pub sensor: SensorArgs,
    /// Drop the bins that remain after --rebin; otherwise it must divide the number of bins
    #[arg(long)]
    pub drop_left_over: bool,
    /// Add the sensor's pulse, scale and noise to photon counts as well, which have their own
    #[arg(long)]
    pub on_counts: bool,
    /// Profile: counts-u16, sqrt-u16, coarse, plain-f32 or lossless [default: counts-u16, with
    /// --no-poisson sqrt-u16]
    #[arg(long, value_name = "NAME")]
    pub profile: Option<String>,
    /// Seed of the noise
    #[arg(long, default_value_t = 0, value_parser = super::ranges::whole)]
    pub seed: u64,
    /// Threads [default: all cores]
    #[arg(long, value_parser = super::ranges::threads)]
    pub threads: Option<usize>,
}

#[derive(Args)]
pub struct DatasetReport {
    /// Folders or URLs of reconstructions, in the order of the page
    #[arg(required = true, value_name = "PLACE", value_parser = crate::args::location::parse)]
    pub places: Vec<String>,
    /// Page to write, with its data as JSON next to it
    #[arg(long, value_name = "FILE", default_value = "reconstructions.html")]
    pub out: PathBuf,
    /// Title of the page
    #[arg(long, default_value = "Reconstructed rooms")]
    pub title: String,
}

#[derive(Args)]
pub struct DatasetSplit {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Name of the split
    #[arg(long, default_value = "default")]
    pub name: String,
    /// Numbers of scenes for training, validation and test, in total all scenes, e.g.
    /// 87688,3744,6000
    #[arg(long, value_name = "N,N,N", value_parser = three::<u64>, required_unless_present_any = ["fractions", "show"])]
    pub counts: Option<[u64; 3]>,
    /// Shares for training, validation and test, e.g. 0.9,0.04,0.06
    #[arg(long, value_name = "F,F,F", value_parser = three::<f64>, conflicts_with = "counts")]
    pub fractions: Option<[f64; 3]>,
    /// Seed of the hash that orders the scenes
    #[arg(long, default_value_t = 0, value_parser = super::ranges::whole)]
    pub seed: u64,
    /// Only show the newest version
    #[arg(long, conflicts_with_all = ["counts", "fractions", "seed"])]
    pub show: bool,
}

#[derive(Args)]
pub struct DatasetExport {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Folder or URL for the export
    #[arg(value_parser = crate::args::location::parse)]
    pub dest: String,
    /// Scenes: A..B, split:train, split:validation, split:test or split:NAME:SIDE [default: all]
    #[arg(long, value_name = "SCENES", value_parser = Scenes::parse)]
    pub scenes: Option<Scenes>,
    /// Format: zarr (packed, 16 scenes per file), sb3d (Shoot-Bounce-3D's), webdataset or hdf5
    #[arg(long, default_value = "zarr", value_name = "NAME", value_parser = ExportFormat::parse)]
    pub format: ExportFormat,
}

#[derive(Args)]
#[command(after_long_help = IMPORT_HELP)]
pub struct DatasetImport {
    /// Folder with the files
    pub source: PathBuf,
    /// Folder or URL of the data set to write or continue
    #[arg(value_parser = crate::args::location::parse)]
    pub target: String,
    /// Format of the files: sb3d, platonerf, bf-lidar or npy [default: detected]
    #[arg(long, value_name = "NAME", value_parser = Format::parse)]
    pub format: Option<Format>,
    /// File with the names of scenes to import, one per line, in order [default: all, by name]
    #[arg(long, value_name = "FILE")]
    pub list: Option<PathBuf>,
    /// Profile: sqrt-u16, coarse, plain-f32, lossless or counts-u16
    #[arg(long, default_value = "sqrt-u16", value_name = "NAME")]
    pub profile: String,
    #[command(flatten)]
    pub options: ImportArgs,
    /// Compare the contents of files of imported scenes, not only their sizes
    #[arg(long)]
    pub rehash: bool,
    /// Threads [default: all cores]
    #[arg(long, value_parser = super::ranges::threads)]
    pub threads: Option<usize>,
}

const IMPORT_HELP: &str = "\
What the files say is read; what a format is known for (gate, field of view, polarity, axes) is checked against the
histograms: two-bounce light must arrive where depth and spots predict. What does not fit is refused, naming the file,
what was expected and the option that overrides it. The manifest of each scene names its files with their SHA-256,
everything that was converted, and what is missing; stages refuse scenes without what they need. Run the same command
again to go on.

A beam that a mirror folds is longer than the straight line from the laser to its spot. Where a source does not state the
lengths and the camera sees a mirror (or nobody says), they are listed as missing (spots.path), and shadow networks that are
given two-bounce times cannot use the scene; --straight-beams states that no mirror folds a beam.

npy: a folder a scene, or one of such folders, with .npy files and scene.json:
  {\"format\": \"picofarm-scene-1\", \"length_unit\": \"m\" (or cm, mm),
   \"histogram\": {\"file\": \"h.npy\", \"axes\": [\"row\", \"column\", \"bin\"] (in the array's order),
                 \"gate_start\": 1.0, \"bin_width\": 0.0384, \"gate_unit\": \"length\" (of path; or s, ns, ps)},
   \"camera\": {\"fx\": 128, \"fy\": 128, \"cx\": 128, \"cy\": 128, \"pixel_centre\": 0.5 (or 0),
              \"axes\": [\"right\", \"down\", \"forward\"] (or left, up, backward, in any order),
              \"to_world\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]] (if known)},
   \"laser\": [0, 0, 0], \"spots\": {\"file\": \"spots.npy\" (spots x 3), \"paths\": \"paths.npy\" (length of each beam, if known)},
   \"depth\": {\"file\": \"depth.npy\", \"kind\": \"z\" (or range)}}
and, if there are any: visibility {file, one_means: lit or shadow} (spots x rows x columns), specular {file} (1 = mirror),
normal {file}, instance {file} and label {file} (0 = nothing), rgb_linear {file}, photons_per_unit, two_bounce {file} (spots x rows
x columns: measured path of each spot's two-bounce light, 0 = none; depth may then be left out, and nothing is checked).

bf-lidar: with --captures sum, t2.mat and two_bounce_detections.mat beside the captures are taken along.";

/// What overrides the files, or what their format is known for.
#[derive(Args, Clone, Default)]
pub struct ImportArgs {
    /// Optical path at the start of the first bin, metres (sb3d, platonerf), or of the first bin to
    /// keep (bf-lidar)
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub gate_start_m: Option<f64>,
    /// Width of a bin, metres of optical path (sb3d, platonerf, bf-lidar)
    #[arg(long, value_name = "M")]
    pub bin_width_m: Option<f64>,
    /// Number of bins to keep (bf-lidar)
    #[arg(long, value_name = "N")]
    pub bins: Option<u32>,
    /// Horizontal field of view, degrees (sb3d, platonerf)
    #[arg(long, value_name = "DEG")]
    pub fov_deg: Option<f64>,
    /// Unit of depth and spots, in metres (sb3d)
    #[arg(long, value_name = "M")]
    pub length_unit_m: Option<f64>,
    /// Meaning of 1 in the visibility masks (sb3d)
    #[arg(long, value_enum)]
    pub visibility: Option<PolarityArg>,
    /// Meaning of the depth image (sb3d)
    #[arg(long, value_enum)]
    pub depth: Option<DepthArg>,
    /// Histograms to import: of 4, 25 or 100 spots (sb3d) [default: the most]
    #[arg(long, value_name = "N")]
    pub spots: Option<u32>,
    /// Position of the laser in the scan's axes: x left, y up, z forward (bf-lidar)
    #[arg(long, value_name = "X,Y,Z", value_parser = three::<f64>, allow_negative_numbers = true)]
    pub laser_m: Option<[f64; 3]>,
    /// Arrival time at zero distance, seconds (bf-lidar)
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub t0_s: Option<f64>,
    /// Captures of single spots: one scene each, the sum of a folder as one scene (platonerf,
    /// bf-lidar), or a scene with both the sum and each capture (bf-lidar)
    #[arg(long, value_enum, default_value_t = CapturesArg::Separate)]
    pub captures: CapturesArg,
    /// No mirror folds a beam: each is straight from the laser to its spot (sb3d, npy)
    #[arg(long)]
    pub straight_beams: bool,
    /// Skip the check of histograms against geometry; the manifest records this
    #[arg(long)]
    pub unchecked: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PolarityArg {
    Lit,
    Shadow,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DepthArg {
    Z,
    Range,
}

#[derive(Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum CapturesArg {
    #[default]
    Separate,
    Sum,
    Both,
}

impl ImportArgs {
    /// Converts the arguments to the importer's options.
    pub fn options(&self) -> ImportOptions {
        ImportOptions {
            gate_start_m: self.gate_start_m,
            bin_width_m: self.bin_width_m,
            bins: self.bins,
            fov_deg: self.fov_deg,
            length_unit_m: self.length_unit_m,
            visibility: self.visibility.map(|v| match v {
                PolarityArg::Lit => Polarity::Lit,
                PolarityArg::Shadow => Polarity::Shadow,
            }),
            depth: self.depth.map(|d| match d {
                DepthArg::Z => DepthKind::Z,
                DepthArg::Range => DepthKind::Range,
            }),
            spots: self.spots,
            laser_m: self.laser_m,
            t0_s: self.t0_s,
            captures: match self.captures {
                CapturesArg::Separate => Captures::Separate,
                CapturesArg::Sum => Captures::Sum,
                CapturesArg::Both => Captures::Both,
            },
            straight_beams: self.straight_beams,
            unchecked: self.unchecked,
        }
    }
}

fn three<T: std::str::FromStr>(text: &str) -> Result<[T; 3], String> {
    let expected = || "expected three numbers: training,validation,test".to_owned();
    let number = |part: &str| part.trim().parse().map_err(|_| expected());
    let all = text.split(',').map(number).collect::<Result<Vec<T>, _>>()?;
    all.try_into().map_err(|_| expected())
}
