//! Render settings, their form in a job file, and the checks.

use std::collections::BTreeMap;

use picofarm_settings::{
    BeamWidth, Budget, Choice, Gate, Optics, Resolution, Strategy, Wavelength,
};
use serde::{Deserialize, Serialize, Serializer};

use crate::spec::{
    SceneKind,
    spec_error::{SpecError, within},
};

/// Settings of a render.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RenderSettingsText")]
pub struct RenderSettings {
    /// Image width and height in pixels: a number, or width and height as `"320x240"`.
    pub resolution: Resolution,
    /// ℓ_min, metres of optical path.
    pub gate_start_m: f64,
    /// Δ, metres.
    pub bin_width_m: f64,
    /// Number of bins.
    pub bins: u32,
    /// Whether start and width of the bins are still to be fitted to the scenes' files, which
    /// submission does: written as `gate = "auto"`.
    #[serde(
        rename = "gate",
        skip_serializing_if = "std::ops::Not::not",
        serialize_with = "auto"
    )]
    pub fit_gate: bool,
    /// Multi-bounce work: `samples = N` (paths per pixel) or `error = 0.1` (target).
    #[serde(flatten)]
    pub budget: Budget,
    /// Longest path in bounces; 0 means until the gate ends.
    pub max_bounces: u32,
    /// Version of the renderer, part of every task key; filled in at submission if omitted.
    pub renderer: String,
    /// Subsets of the 10×10 grid of spots with a histogram of their own, from the same rays: 4 and
    /// 25, ascending.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub subsets: Vec<u32>,
    /// Whether each spot gets a histogram of its own, from the same rays.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub per_spot: bool,
    /// Techniques of the renderer chosen by hand. The renderer chooses the others.
    #[serde(skip_serializing_if = "Strategy::is_default")]
    pub strategy: Strategy,
    /// The optics of laser and pixels.
    #[serde(flatten)]
    pub optics: Optics,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn auto<S: Serializer>(_fit: &bool, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(AUTO)
}

/// The gate that submission fits to the files.
const AUTO: &str = "auto";

impl Default for RenderSettings {
    /// Returns the measurement contract's default gate: [1.0, 25.45584) m in 637 bins of 0.0384 m,
    /// 256×256 px.
    fn default() -> Self {
        Self {
            resolution: Resolution::square(256),
            gate_start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 637,
            fit_gate: false,
            budget: Budget::Samples(32),
            max_bounces: 0,
            renderer: String::new(),
            subsets: vec![],
            per_spot: false,
            strategy: Strategy::default(),
            optics: Optics::default(),
        }
    }
}

impl RenderSettings {
    /// Returns the recorded interval.
    pub fn gate(&self) -> Gate {
        Gate {
            start_m: self.gate_start_m,
            bin_width_m: self.bin_width_m,
            bins: self.bins,
        }
    }
}

impl RenderSettings {
    /// The available subsets of the 10×10 grid of spots.
    pub const SUBSETS: [u32; 2] = [4, 25];

    /// Widest bin, metres of optical path.
    pub const MAX_BIN_M: f64 = 10.0;

    /// Most pixels of an image's side.
    pub const MAX_SIDE: u32 = 4096;

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("render.{field}"), what));
        for side in [self.resolution.width, self.resolution.height] {
            let sides = (1, Self::MAX_SIDE);
            within("render.resolution", side, sides, "pixels a side")?;
        }
        // No room returns light after 10 km.
        let start = "metres of optical path (there and back); 1 ns of delay is 0.3 m";
        within("render.gate_start_m", self.gate_start_m, (0.0, 1e4), start)?;
        // From a hundredth of a picosecond to 33 ns, beyond any detector on either side.
        // Picoseconds mistaken for metres are outside this range.
        let width = "metres of optical path; 1 ps is 0.0002998 m, so 128 ps are 0.0384";
        let widths = (1e-6, Self::MAX_BIN_M);
        within("render.bin_width_m", self.bin_width_m, widths, width)?;
        within("render.bins", self.bins, (1, 65_536), "bins")?;
        if let Some(n) = self.subsets.iter().find(|n| !Self::SUBSETS.contains(n)) {
            return fail(
                "subsets",
                format!(
                    "{n} is no subset of the 10x10 grid of spots; there are {:?}",
                    Self::SUBSETS
                ),
            );
        }
        if !self.subsets.is_sorted_by(|a, b| a < b) {
            return fail(
                "subsets",
                format!("{:?} must name each once, ascending", self.subsets),
            );
        }
        match self.budget {
            Budget::Samples(n) => {
                let unit = "paths a pixel; two at least, to estimate their error";
                within("render.samples", n, (2, 1_048_576), unit)?;
            }
            Budget::Error(e) => {
                check_share(e).map_err(|what| SpecError::new("render.error", what))?
            }
        }
        self.optics
            .check()
            .map_err(|(field, what)| SpecError::new(format!("render.{field}"), what))?;
        match self.max_bounces {
            1 => fail(
                "max_bounces",
                "1 keeps nothing but the spots; use 0 (all) or at least 2".into(),
            ),
            n => within("render.max_bounces", n, (0, 1_000_000), "bounces; 0 is all"),
        }
    }
}

/// Longest path of two-bounce light in a room of at most 4.5 m a side, metres; the default gate
/// ends there.
const ROOM_PATH_M: f64 = 25.456;
/// Shortest gate that records the two-bounce light of most rooms, metres of path.
const ROOM_GATE_M: f64 = 8.0;
/// Widest bin that distinguishes the depths in a room, metres of path.
const ROOM_BIN_M: f64 = 0.5;
/// Errors below this take thousands of paths a pixel.
const SMALL_ERROR: f64 = 0.005;

impl RenderSettings {
    /// Returns warnings about valid settings that are probably mistakes for such scenes, each with
    /// its field.
    pub(super) fn remarks(&self, scenes: &SceneKind) -> Vec<String> {
        let mut remarks = Vec::new();
        let gate = self.gate();
        let (start, end, width) = (gate.start_m, gate.end_m(), gate.bin_width_m);
        let (rooms, desktop) = match scenes {
            SceneKind::Furnished { .. } => (true, false),
            SceneKind::Primitive { rooms } => (true, rooms.scale[1] < 1.0),
            SceneKind::Files { .. } => (false, false),
        };
        if rooms && start >= ROOM_PATH_M {
            remarks.push(format!(
                "render.gate_start_m = {start}: light in generated rooms returns within {ROOM_PATH_M} m of path, so all \
                 histograms will be empty; the default is 1"
            ));
        } else if rooms && !desktop && end < ROOM_GATE_M {
            remarks.push(format!(
                "render.bins = {} of {width} m: the gate ends at {end:.2} m of path, before most light of a room \
                 returns; the default ends at {ROOM_PATH_M} m",
                self.bins
            ));
        }
        if width > ROOM_BIN_M {
            remarks.push(format!(
                "render.bin_width_m = {width}: a bin of {:.0} ns cannot tell the depths in a room apart; 128 ps are 0.0384 m",
                width / 0.299_792_458
            ));
        }
        if let Budget::Error(error) = self.budget
            && error < SMALL_ERROR
        {
            remarks.push(format!(
                "render.error = {error}: takes about {:.0e} paths a pixel, {:.0e} times the work of 0.1",
                8.0 * (0.1 / error).powi(2),
                (0.1 / error).powi(2)
            ));
        }
        remarks
    }
}

/// The written form of `[render]`. Unknown fields are refused.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RenderSettingsText {
    resolution: Option<Resolution>,
    gate_start_m: Option<f64>,
    bin_width_m: Option<f64>,
    bins: Option<u32>,
    gate: Option<GateText>,
    samples: Option<u32>,
    error: Option<Share>,
    max_bounces: Option<u32>,
    renderer: Option<String>,
    #[serde(default)]
    subsets: Vec<u32>,
    #[serde(default)]
    per_spot: bool,
    #[serde(default)]
    strategy: BTreeMap<String, Choice>,
    beam: Option<BeamWidth>,
    fill_factor: Option<f64>,
    #[serde(default)]
    wavelengths_nm: Vec<f64>,
}

/// A gate as a whole: `"auto"`, or start and end in metres of optical path.
#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "expected \"auto\", or start and end in metres such as [1, 25]"
)]
enum GateText {
    Named(String),
    Range([f64; 2]),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Share {
    Number(f64),
    Text(String),
}

/// Parses "10%" or "0.1" as 0.1.
///
/// # Errors
/// Returns a message with the expected form.
pub fn parse_share(text: &str) -> Result<f64, String> {
    let (number, scale) = match text.trim().strip_suffix('%') {
        Some(percent) => (percent, 0.01),
        None => (text.trim(), 1.0),
    };
    let value = number.trim().parse::<f64>();
    let value = value.map_err(|_| format!("{text:?} is not a share; write \"10%\" or 0.1"))?;
    let share = value * scale;
    check_share(share).map(|()| share)
}

/// Checks the target error of a render. An error of 1 is no target, and an error of 0 is
/// unreachable.
///
/// # Errors
/// Returns a message with the expected range.
fn check_share(share: f64) -> Result<(), String> {
    if (1e-6..1.0).contains(&share) {
        return Ok(());
    }
    let meant = match share {
        1.0..=100.0 => format!("; did you mean \"{share}%\"?"),
        _ => String::new(),
    };
    Err(format!(
        "{share} is {} %, and lies outside 0.0001 %..100 %; write \"10%\" or 0.1{meant}",
        share * 100.0
    ))
}

impl RenderSettingsText {
    /// Returns the gate, and whether it is still to be fitted to the files.
    fn gate(&self, usual: Gate) -> Result<(Gate, bool), SpecError> {
        const EXPECTED: &str = "expected \"auto\", or start and end in metres such as [1, 25]";
        let fail = |what: String| Err(SpecError::new("render.gate", what));
        let stated = Gate {
            start_m: self.gate_start_m.unwrap_or(usual.start_m),
            bin_width_m: self.bin_width_m.unwrap_or(usual.bin_width_m),
            bins: self.bins.unwrap_or(usual.bins),
        };
        let others = (stated.start_m, stated.bin_width_m) != (usual.start_m, usual.bin_width_m);
        match &self.gate {
            None => Ok((stated, false)),
            Some(_) if others => {
                fail("replaces gate_start_m and bin_width_m; keep one of the two forms".into())
            }
            Some(GateText::Named(name)) if name == AUTO => Ok((stated, true)),
            Some(GateText::Named(name)) => fail(format!("{name:?}: {EXPECTED}")),
            Some(GateText::Range([start, end])) => {
                if !(*start >= 0.0 && end > start && end.is_finite()) {
                    return fail(format!("[{start}, {end}]: {EXPECTED}"));
                }
                let fitted = Gate {
                    start_m: *start,
                    bin_width_m: (end - start) / f64::from(stated.bins),
                    ..stated
                };
                Ok((fitted, false))
            }
        }
    }
}

impl TryFrom<RenderSettingsText> for RenderSettings {
    type Error = SpecError;

    fn try_from(text: RenderSettingsText) -> Result<Self, SpecError> {
        let default = RenderSettings::default();
        let (gate, fit_gate) = text.gate(default.gate())?;
        let budget = match (text.samples, text.error) {
            (Some(_), Some(_)) => {
                return Err(SpecError::new(
                    "render.error",
                    "samples and error exclude each other; keep one",
                ));
            }
            (Some(n), None) => Budget::Samples(n),
            (None, Some(Share::Number(e))) => Budget::Error(e),
            (None, Some(Share::Text(e))) => {
                Budget::Error(parse_share(&e).map_err(|m| SpecError::new("render.error", m))?)
            }
            (None, None) => default.budget,
        };
        let mut strategy = Strategy::default();
        for (name, choice) in text.strategy {
            strategy
                .choose(&name, choice)
                .map_err(|what| SpecError::new("render.strategy", what))?;
        }
        // The order in which subsets are written must not affect the results.
        let mut subsets = text.subsets;
        subsets.sort_unstable();
        Ok(RenderSettings {
            resolution: text.resolution.unwrap_or(default.resolution),
            gate_start_m: gate.start_m,
            bin_width_m: gate.bin_width_m,
            bins: gate.bins,
            fit_gate,
            budget,
            max_bounces: text.max_bounces.unwrap_or(default.max_bounces),
            renderer: text.renderer.unwrap_or_default(),
            subsets,
            per_spot: text.per_spot,
            strategy,
            optics: Optics {
                beam: text.beam,
                fill_factor: text.fill_factor.unwrap_or(default.optics.fill_factor),
                wavelengths_nm: Wavelength::of(&text.wavelengths_nm).map_err(|(at, what)| {
                    SpecError::new(format!("render.wavelengths_nm{at}"), what)
                })?,
            },
        })
    }
}
