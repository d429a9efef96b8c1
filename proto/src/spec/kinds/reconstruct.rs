//! Reconstruction: turns each scene of a data set into a room in 3D, from two-bounce light. One
//! task a scene.

use picofarm_settings::{FieldKind, GridSettings, MlpSettings, Sensor, SensorError, Shadows};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Results, TaskKind},
};
use crate::spec::{
    limits::check_count,
    memory::{BASE, Known, Shape},
    places::{OutputSettings, SourceSettings, check_source, default_profile},
    spec_error::SpecError,
};

/// Bytes of a node of the grid during fitting: 19 to 25 were measured at 256 to 128 nodes.
const NODE: f64 = 28.0;
/// Bytes of networks during fitting: a constant, the bytes for each neuron of a layer (values that
/// 64 rays store for their gradients), and for each weight of a layer. 59, 227 and 863 MiB were
/// measured at widths of 8, 64 and 256.
const NETWORKS: f64 = 48.0 * 1024.0 * 1024.0;
const NEURON: f64 = 3.3 * 1024.0 * 1024.0;
const WEIGHT: f64 = 1024.0;
/// Bytes of a pixel for each spot: its time, its mask, its strongest return, and all of them twice
/// while masks are compared.
const PATH: f64 = 40.0;
/// Name of the ability to fit networks.
pub const MLP: &str = "mlp";
/// Most novel views of a scene.
const MOST_VIEWS: u32 = 1_000;

/// Reconstructs a density field, a mesh and their errors for each scene of a data set: one task a
/// scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReconstructTask {
    /// The data set with the scenes.
    pub source: SourceSettings,
    /// The number of scenes for which the source has room.
    pub count: u64,
    /// The inputs and the method.
    pub reconstruct: ReconstructSettings,
    /// The destination of reconstructions: a separate folder next to data sets. Reconstructions
    /// have no histograms, and therefore no profile.
    pub output: OutputSettings,
}

/// The inputs and the method of a reconstruction.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReconstructSettings {
    /// Source of two-bounce times and shadow masks.
    pub from: Measurements,
    /// With `from = "predictions"`: an infer stage, or the folder in the source's store that an
    /// infer stage wrote, with depth and masks.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub predictions: String,
    /// Only these spots, ascending; empty means all.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// Treatment of pixels that are known to see a mirror.
    #[serde(skip_serializing_if = "Mirrors::is_default")]
    pub mirrors: Mirrors,
    /// With `from = "captures"`: the detector that counts the photons. Without it, the rendered
    /// histograms are the measurements. Its seed is the grid's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensor: Option<Sensor>,
    /// Number of novel views at which the depth is compared with the scene's, which is generated
    /// again for this; 0 means none.
    pub views: u32,
    /// Representation of the density: a grid, or PlatoNeRF's networks.
    #[serde(skip_serializing_if = "is_grid")]
    pub field: FieldKind,
    /// The grid. Networks are sampled on it, with its `nodes` and `seed`.
    pub grid: GridSettings,
    /// With `field = "mlp"`: the networks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mlp: Option<MlpSettings>,
    /// Version of the reconstruction, part of every task key; filled in at submission if omitted.
    pub version: String,
}

/// Source of two-bounce times and shadow masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measurements {
    /// The ground truth's depth and visibility.
    #[default]
    Truth,
    /// The predictions of networks from one histogram (Shoot-Bounce-3D, appendices C and E).
    Predictions,
    /// A histogram of each spot alone (`per_spot = true` in the render stage), through PlatoNeRF's
    /// matched filter.
    Captures,
    /// Two-bounce paths and masks of an import (`two_bounce_path`), from bounce-flash lidar or from
    /// the user.
    Given,
}

/// Treatment of pixels that see a mirror. Light reaches and leaves a mirror on paths that
/// contradict the assumption of two-bounce times, so that the method leaves the treatment open
/// (Shoot-Bounce-3D, appendix E).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mirrors {
    /// They are excluded.
    #[default]
    LeaveOut,
    /// They are treated like any other pixel. A network that predicts depth predicts the mirror's
    /// own.
    Keep,
}

impl Mirrors {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

fn is_grid(field: &FieldKind) -> bool {
    *field == FieldKind::Grid
}

/// Returns the most bytes that a grid of `nodes` nodes along its longest side takes while it is
/// fitted to images of this shape.
pub fn grid_bytes(nodes: u32, shape: &Shape) -> u64 {
    let paths = PATH * shape.pixels() * f64::from(shape.spots);
    (NODE * f64::from(nodes).powi(3) + paths) as u64
}

/// Returns the most bytes that networks of this width take during fitting.
fn mlp_bytes(width: u32) -> f64 {
    NETWORKS + NEURON * f64::from(width) + WEIGHT * f64::from(width).powi(2)
}

/// The field of [`ReconstructSettings::predictions`].
const PREDICTIONS: &str = "reconstruct.predictions";

fn is_given(folder: &str) -> bool {
    !folder.is_empty()
}

impl Declared for ReconstructTask {
    const NAME: &'static str = "reconstruct";
    const FIELDS: &'static [&'static str] = &["source", "count", "reconstruct", "output"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            reconstruct: fields.or_default("reconstruct")?,
            output: fields.required("output")?,
        })
    }
}

impl TaskKind for ReconstructTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("reconstruct.version", &self.reconstruct.version),
            source: Some(&self.source),
            folder: is_given(&self.reconstruct.predictions)
                .then_some((PREDICTIONS, &self.reconstruct.predictions)),
            makes: Makes::PerScene(&self.output),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.reconstruct.version),
            source: Some((&mut self.source, &mut self.count)),
            folder: is_given(&self.reconstruct.predictions)
                .then_some((PREDICTIONS, &mut self.reconstruct.predictions)),
            stores: vec![("output.store", &mut self.output.store)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.reconstruct.check()?;
        let to = &self.output;
        let folder = |name: &String| (&self.source.store, name) == (&to.store, &to.dataset);
        if folder(&self.source.dataset) || folder(&self.reconstruct.predictions) {
            let what = format!(
                "{:?} is read by this stage; choose another folder for the reconstructions",
                to.dataset
            );
            return Err(SpecError::new("output.dataset", what));
        }
        if to.profile != default_profile() {
            let what = format!(
                "{:?} is how histograms are coded, and reconstructions have none; remove it",
                to.profile
            );
            return Err(SpecError::new("output.profile", what));
        }
        to.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "reconstruct",
            "source": self.source.shaping(),
            "settings": self.reconstruct,
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        let spots = match self.reconstruct.spots.len() {
            0 => source.spots,
            chosen => chosen as u32,
        };
        let used = Shape { spots, ..*source };
        let histogram = match self.reconstruct.from {
            Measurements::Captures => 2.0 * source.histogram(),
            _ => 0.0,
        };
        let grid = grid_bytes(self.reconstruct.grid.nodes, &used) as f64;
        let networks = self.reconstruct.mlp.map_or(0.0, |mlp| mlp_bytes(mlp.width));
        Some(BASE + source.truth() + histogram + grid + networks)
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.count,
            resumes: self.reconstruct.field == FieldKind::Mlp,
            variant: (self.reconstruct.field == FieldKind::Mlp).then_some(MLP),
        }
    }
}

impl ReconstructSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail =
            |field: &str, what: String| Err(SpecError::new(format!("reconstruct.{field}"), what));
        match (self.from, &*self.predictions) {
            (Measurements::Predictions, "") => {
                return fail(
                    "predictions",
                    "is empty; name an infer stage, or the folder that one wrote, as in predictions = \"seen\"".into(),
                );
            }
            (from, named) if from != Measurements::Predictions && !named.is_empty() => {
                return fail(
                    "predictions",
                    format!(
                        "is {named:?}, which only from = \"predictions\" reads; remove it, or say so"
                    ),
                );
            }
            _ => {}
        }
        if self.from == Measurements::Captures && self.mirrors != Mirrors::default() {
            let what =
                "says what becomes of mirrors, which from = \"captures\" does not know; remove it";
            return fail("mirrors", what.into());
        }
        if let Some(sensor) = &self.sensor {
            if self.from != Measurements::Captures {
                let what = "counts the photons of captures; add from = \"captures\", or remove it";
                return fail("sensor", what.into());
            }
            if sensor.rebin != 1 {
                let what = format!(
                    "is {}; captures keep their bins: leave it out",
                    sensor.rebin
                );
                return fail("sensor.rebin", what);
            }
            if let Some(field) = sensor.needs_image() {
                let what = "changes the pixels or bins of a whole image, which are kept here: leave it out, or \
                            make a data set with it first by a stage of kind \"reprocess\"";
                return fail(&format!("sensor.{field}"), what.into());
            }
            sensor
                .check()
                .or_else(|SensorError::Invalid { field, what }| fail(&field, what))?;
        }
        if !self.spots.is_sorted_by(|a, b| a < b) {
            return fail(
                "spots",
                format!("{:?} must name each once, ascending", self.spots),
            );
        }
        if self.views > MOST_VIEWS {
            return fail(
                "views",
                format!("is {}, at most {MOST_VIEWS} are compared", self.views),
            );
        }
        match (self.field, &self.mlp) {
            (FieldKind::Grid, None) => {}
            (FieldKind::Grid, Some(_)) => {
                let what = "is of networks; add field = \"mlp\", or remove it";
                return fail("mlp", what.into());
            }
            (FieldKind::Mlp, None) => {
                let what = "is missing; say how many, as in mlp = { steps = 1000, width = 64, batch = 256 }. The paper takes \
                            200,000 of width 256 and 1,024 rays: weeks on a CPU";
                return fail("mlp.steps", what.into());
            }
            (FieldKind::Mlp, Some(mlp)) => {
                mlp.check()
                    .or_else(|(field, what)| fail(&format!("mlp.{field}"), what))?;
                if self.grid.shadows != Shadows::default() {
                    let what = "is of grids: networks learn from shadows themselves; remove it";
                    return fail("grid.shadows", what.into());
                }
            }
        }
        self.grid
            .check()
            .or_else(|(field, what)| fail(&format!("grid.{field}"), what))
    }
}
