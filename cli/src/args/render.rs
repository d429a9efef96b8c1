//! Arguments of commands that render: `scene render`, `scene plan`.

use std::path::PathBuf;

use clap::Args;
use picofarm_settings::Resolution;
use picofarm_transient::{BeamWidth, Gate, Optics, Wavelength};

use super::SceneInput;

use crate::{
    args::{
        groups::{Group, Named},
        strategy::Chosen,
    },
    error::{CliError, Result},
};

/// What to render and how.
#[derive(Args)]
pub struct RenderArgs {
    /// A .glb, .gltf, .xml (Mitsuba), .json, .ply, .obj or .stl file
    pub file: PathBuf,
    #[command(flatten)]
    pub input: SceneInput,
    /// Image width in pixels, or width and height as 320x240; the height follows from the camera
    /// [default: the scene's own]
    #[arg(long, value_name = "PX|WxH", value_parser = resolution)]
    pub resolution: Option<ImageSize>,
    /// Render until the median error of a pixel is this share, e.g. 10%
    #[arg(long, conflicts_with = "samples", value_parser = picofarm_proto::spec::parse_share)]
    pub error: Option<f64>,
    /// Camera paths per pixel [default: 64]
    #[arg(long)]
    pub samples: Option<u32>,
    /// Seed of the random numbers
    #[arg(long, default_value_t = 0, value_parser = super::ranges::whole)]
    pub seed: u64,
    /// Longest path in bounces [default: until the gate ends]
    #[arg(long)]
    pub max_bounces: Option<u32>,
    /// Also write histograms of some spots, from the same rays: 4 or 25 of a 10x10 grid, or
    /// per-spot for each beam
    #[arg(long, value_delimiter = ',', value_name = "4|25|per-spot,…", value_parser = crate::args::groups::parse)]
    pub groups: Vec<Group>,
    /// Also write a histogram of these beams, counted from 0, as array transient_NAME; may be
    /// repeated
    #[arg(long, value_name = "NAME=BEAM,…", value_parser = crate::args::groups::parse_named)]
    pub group: Vec<Named>,
    /// Choose techniques by hand, e.g. path-reuse=1,mirror-images=off [default: chosen by the
    /// scene]
    #[arg(long, value_delimiter = ',', value_name = "NAME=VALUE,…", value_parser = crate::args::strategy::parse)]
    pub strategy: Vec<Chosen>,
    #[command(flatten)]
    pub optics: OpticsArgs,
    /// Threads [default: all cores]
    #[arg(long, value_parser = super::ranges::threads)]
    pub threads: Option<usize>,
    #[command(flatten)]
    pub gate: GateArgs,
    /// Time gate as a whole: auto fits it to the scene; START,END in metres of optical path fit the
    /// bins into it [default: the options above, but auto if their defaults would miss much of the
    /// scene]
    #[arg(long = "gate", value_name = "auto|START,END", value_parser = gate_choice,
          conflicts_with_all = ["gate_start_m", "bin_width_m"])]
    pub gate_choice: Option<GateChoice>,
}

/// A size of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    pub width: u32,
    /// The height; `None` follows from the camera.
    pub height: Option<u32>,
}

impl ImageSize {
    /// Returns the size if the height is stated.
    pub fn whole(self) -> Option<Resolution> {
        let Self { width, height } = self;
        height.map(|height| Resolution { width, height })
    }
}

/// Parses a width, or a width and a height.
fn resolution(text: &str) -> std::result::Result<ImageSize, String> {
    let side = |text: &str| -> Option<u32> {
        let side = text.trim().parse().ok()?;
        (1..=4096).contains(&side).then_some(side)
    };
    let parsed = match text.split_once('x') {
        Some((width, height)) => side(width).zip(side(height)).map(|(w, h)| (w, Some(h))),
        None => side(text).map(|w| (w, None)),
    };
    let (width, height) =
        parsed.ok_or("expected 1 to 4096 pixels, or width and height such as 320x240")?;
    Ok(ImageSize { width, height })
}

/// A time gate as a whole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GateChoice {
    /// Fitted to the scene.
    Auto,
    /// From start to end, metres of optical path.
    Range([f64; 2]),
}

fn gate_choice(text: &str) -> std::result::Result<GateChoice, String> {
    if text == "auto" {
        return Ok(GateChoice::Auto);
    }
    let range = text.split_once(',').and_then(|(start, end)| {
        let range = [start.trim().parse().ok()?, end.trim().parse().ok()?];
        (range[0] >= 0.0 && range[1] > range[0] && f64::is_finite(range[1])).then_some(range)
    });
    range
        .map(GateChoice::Range)
        .ok_or_else(|| "expected auto, or start and end in metres such as 1,25".into())
}

/// The optics of laser and pixels.
#[derive(Args)]
pub struct OpticsArgs {
    /// Diameter of the beams at the laser, millimetres, at 1/e² of the intensity [default: 0]
    #[arg(long, value_name = "MM")]
    pub beam_diameter_mm: Option<f64>,
    /// Divergence of the beams, full angle, milliradians, at 1/e² of the intensity [default: 0]
    #[arg(long, value_name = "MRAD")]
    pub beam_divergence_mrad: Option<f64>,
    /// Rays per beam with a width [default: 16]
    #[arg(long, value_name = "N")]
    pub beam_points: Option<u32>,
    /// Share of each pixel's area that is sensitive, a square in its middle [default: 1]
    #[arg(long, value_name = "SHARE")]
    pub fill_factor: Option<f64>,
    /// Wavelength of the laser, nanometres [default: that of the scene's reflectances]
    #[arg(long, value_delimiter = ',', value_name = "NM")]
    pub wavelengths_nm: Vec<f64>,
}

impl OpticsArgs {
    /// Returns the optics.
    ///
    /// # Errors
    /// Fails for an invalid wavelength. [`picofarm_proto::spec::RenderSettings::check`] checks the
    /// other options.
    pub fn optics(&self) -> Result<Optics> {
        let default = Optics::default();
        Ok(Optics {
            beam: self.width(),
            fill_factor: self.fill_factor.unwrap_or(default.fill_factor),
            wavelengths_nm: Wavelength::of(&self.wavelengths_nm)
                .map_err(|(at, what)| CliError::input(format!("--wavelengths-nm{at}: {what}")))?,
        })
    }

    /// Returns the beams' width; `None` if no option sets it.
    fn width(&self) -> Option<BeamWidth> {
        let default = BeamWidth::default();
        let said = self.beam_diameter_mm.is_some()
            || self.beam_divergence_mrad.is_some()
            || self.beam_points.is_some();
        said.then(|| BeamWidth {
            diameter_mm: self.beam_diameter_mm.unwrap_or(default.diameter_mm),
            divergence_mrad: self.beam_divergence_mrad.unwrap_or(default.divergence_mrad),
            points: self.beam_points.unwrap_or(default.points),
        })
    }
}

#[derive(Args)]
pub struct SceneRender {
    #[command(flatten)]
    pub render: RenderArgs,
    /// Folder for the Zarr group (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Also write the parts by bounces and their errors: two, multi, two_se, multi_se, two_noise,
    /// multi_noise
    #[arg(long)]
    pub split: bool,
    /// Render for about this many seconds, or until --error or --samples is reached. The result
    /// depends on the machine's speed
    #[arg(long, value_name = "S", value_parser = seconds)]
    pub seconds: Option<f64>,
}

#[derive(Args)]
pub struct ScenePlan {
    #[command(flatten)]
    pub render: RenderArgs,
    /// List classes of paths of three bounces and more by energy and variance, from 64 passes over
    /// a few tiles
    #[arg(long)]
    pub variance: bool,
}

#[derive(Args, Clone, Copy, PartialEq)]
pub struct GateArgs {
    /// Start of the time gate, metres of optical path
    #[arg(long, default_value_t = GateArgs::USUAL.gate_start_m, value_name = "M")]
    pub gate_start_m: f64,
    /// Bin width, metres of optical path
    #[arg(long, default_value_t = GateArgs::USUAL.bin_width_m, value_name = "M")]
    pub bin_width_m: f64,
    /// Number of bins
    #[arg(long, default_value_t = GateArgs::USUAL.bins)]
    pub bins: u32,
}

impl GateArgs {
    /// The default gate.
    pub const USUAL: Self = Self {
        gate_start_m: 1.0,
        bin_width_m: 0.0384,
        bins: 637,
    };

    /// Returns the gate.
    pub fn gate(&self) -> Gate {
        Gate {
            start_m: self.gate_start_m,
            bin_width_m: self.bin_width_m,
            bins: self.bins,
        }
    }
}

/// Parses a positive time.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(s) if s > 0.0 && f64::is_finite(s) => Ok(s),
        _ => Err(format!(
            "{text:?} is no time: expected a positive number of seconds, such as 30"
        )),
    }
}
