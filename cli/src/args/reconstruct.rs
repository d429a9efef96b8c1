//! Arguments of `reconstruct`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use picofarm_settings::Resolution;

use super::{SceneInput, render::GateArgs};

#[derive(Args)]
pub struct Reconstruct {
    /// A .glb, .gltf, .xml (Mitsuba), .json, .ply, .obj or .stl file; or a folder of `picofarm
    /// capture import` or `picofarm scene render`
    pub file: PathBuf,
    #[command(flatten)]
    pub input: SceneInput,
    /// Folder for the results (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Where times and shadows come from: one rendered histogram a spot, all bounces; depth and
    /// visibility of the scene itself; or one rendered histogram of all spots at once, separated by
    /// networks (predictions) or by physics (flash). A folder has captures, if its spots were
    /// measured one by one, and flash [default: captures for a file, flash for a folder]
    #[arg(long, value_enum)]
    pub spots_from: Option<SpotsFrom>,
    #[command(flatten)]
    pub networks: NetworksArgs,
    /// Form of the density: a grid, in seconds, or PlatoNeRF's networks, in hours
    #[arg(long, value_enum, default_value_t = FieldArg::Grid)]
    pub field: FieldArg,
    #[command(flatten)]
    pub mlp: MlpArgs,
    /// Image width and height in pixels of the measurements: 256 is a square, or 320x240
    #[arg(long, default_value_t = Self::RESOLUTION, value_name = "PX|WxH", value_parser = super::ranges::image)]
    pub resolution: Resolution,
    /// Nodes of the density grid along its longest side
    #[arg(long, default_value_t = 192, value_name = "N", conflicts_with = "fine", value_parser = clap::value_parser!(u32).range(16..=512))]
    pub nodes: u32,
    /// Use a grid of 256 nodes, which takes one and a half times as long
    #[arg(long)]
    pub fine: bool,
    /// Do not close the room by planes outside the view
    #[arg(long)]
    pub no_planes: bool,
    /// Continue if the measurements contradict one another; the result records it
    #[arg(long)]
    pub accept_inconsistent: bool,
    /// Novel views for the errors: a circle in the middle of the scene, or PlatoNeRF's 139 in its
    /// room
    #[arg(long, value_enum, default_value_t = ViewsArg::Around)]
    pub views: ViewsArg,
    /// Camera paths per pixel of the captures, for three bounces and more
    #[arg(long, default_value_t = Self::SAMPLES, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_048_576))]
    pub samples: u32,
    #[command(flatten)]
    pub detector: DetectorArgs,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 0, value_parser = super::ranges::whole)]
    pub seed: u64,
    /// Threads [default: all cores]
    #[arg(long, value_parser = super::ranges::threads)]
    pub threads: Option<usize>,
    #[command(flatten)]
    pub gate: GateArgs,
}

/// What belongs to `--spots-from predictions` alone.
#[derive(Args)]
pub struct NetworksArgs {
    /// Folder or URL of the store with the models
    #[arg(long, value_name = "STORE")]
    pub models: Option<String>,
    /// Model that predicts depth
    #[arg(long, value_name = "NAME")]
    pub tof: Option<String>,
    /// Model that predicts which pixels each spot lights
    #[arg(long, value_name = "NAME")]
    pub shadow: Option<String>,
    /// Model that predicts mirrors, whose pixels are left out [default: none]
    #[arg(long, value_name = "NAME")]
    pub specular: Option<String>,
}

/// A detector for `--spots-from captures`; without any of these, the sensor is perfect.
#[derive(Args)]
pub struct DetectorArgs {
    /// Count photons, this many in the brightest bin of the median pixel of each capture
    #[arg(long, value_name = "N", value_parser = super::ranges::photons)]
    pub photons: Option<f64>,
    /// Ambient photons in each bin of each pixel, in addition to --photons
    #[arg(long, value_name = "N", requires = "photons", value_parser = super::ranges::ambient)]
    pub ambient: Option<f64>,
}

/// What belongs to `--field mlp` alone.
#[derive(Args)]
pub struct MlpArgs {
    /// Steps of the networks, an eighth of them on distances alone; PlatoNeRF has 200000
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=100_000_000))]
    pub steps: Option<u32>,
    /// Width of the networks' layers [default: 256]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=1024))]
    pub width: Option<u32>,
    /// Rays per step of the networks [default: 1024]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65_536))]
    pub batch: Option<u32>,
    /// Loss of the networks on shadow masks: PlatoNeRF's squares, or cross-entropy [default:
    /// squares]
    #[arg(long, value_enum)]
    pub shadow_loss: Option<ShadowLossArg>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FieldArg {
    Grid,
    Mlp,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ShadowLossArg {
    Squares,
    CrossEntropy,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SpotsFrom {
    Captures,
    Truth,
    Predictions,
    Flash,
}

impl Reconstruct {
    /// Width and height of the measurements of a scene file.
    pub const RESOLUTION: Resolution = Resolution {
        width: 256,
        height: 256,
    };
    /// Camera paths of a pixel of a scene file.
    pub const SAMPLES: u32 = 16;

    /// Returns where times and shadows come from.
    pub fn source(&self) -> SpotsFrom {
        self.spots_from.unwrap_or(match self.file.is_dir() {
            true => SpotsFrom::Flash,
            false => SpotsFrom::Captures,
        })
    }
}

impl SpotsFrom {
    /// Returns its name on the command line and in metrics.json.
    pub fn name(self) -> &'static str {
        match self {
            Self::Captures => "captures",
            Self::Truth => "truth",
            Self::Predictions => "predictions",
            Self::Flash => "flash",
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ViewsArg {
    Around,
    Plato,
}
