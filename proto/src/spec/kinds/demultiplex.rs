//! Demultiplexing: predicts depth, and the pixels that each spot lights, from the histogram of all
//! spots, by physics and without a network. One task a scene. The predictions have the form of an
//! infer stage's.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Results, TaskKind},
    reprocess::Histogram,
};
use crate::spec::{
    limits::check_count,
    memory::{BASE, Known},
    places::{OutputSettings, SourceSettings, check_source, default_profile},
    spec_error::SpecError,
};

/// Bytes of a pixel for the ranges and the mirrors that the method tries, over the bytes of its
/// histogram.
const RANGES: f64 = 3.5;
/// Bytes of a pixel for each spot: shares of light, probabilities, and what they rest on.
const PAIR: f64 = 40.0;

/// Takes the flash of each scene of a data set apart: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DemultiplexTask {
    /// The data set with the scenes.
    pub source: SourceSettings,
    /// The number of scenes for which the source has room.
    pub count: u64,
    /// The input.
    pub demultiplex: DemultiplexSettings,
    /// The destination of predictions: a separate folder next to data sets. Predictions have no
    /// histograms, and therefore no profile.
    pub output: OutputSettings,
}

/// The method and its input.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DemultiplexSettings {
    /// The method.
    #[serde(skip_serializing_if = "is_default")]
    pub method: Method,
    /// The histogram of several spots: `transient`, `transient_4` or `transient_25`.
    pub histogram: Histogram,
    /// Source of the places of the spots.
    pub places: Places,
    /// Source of the depths at which shadows are judged. With `"truth"`, no depths, mirrors and
    /// confidences are stored.
    #[serde(skip_serializing_if = "is_default")]
    pub depth: DepthSource,
    /// Whether the evidence of each spot is stored too, for networks (`shadow.variant =
    /// "evidence"`).
    #[serde(skip_serializing_if = "is_default")]
    pub evidence: bool,
    /// Version of the method and of the encoder, part of every task key; filled in at submission if
    /// omitted.
    pub version: String,
}

/// The way to depth and shadows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// One flash is taken apart by physics.
    #[default]
    Physics,
    /// PlatoNeRF's matched filter, from a histogram of each spot alone.
    MatchedFilter,
    /// Bounce-flash lidar's peak statistics and likelihood ratio, from a histogram of each spot
    /// alone.
    Likelihood,
}

impl Method {
    /// Returns the name in job files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Physics => "physics",
            Self::MatchedFilter => "matched-filter",
            Self::Likelihood => "likelihood",
        }
    }
}

/// Source of the places of the spots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Places {
    /// The data set.
    #[default]
    Given,
    /// The spots' own one-bounce returns in the histogram. Beams that a mirror folds keep the given
    /// place.
    Returns,
}

/// Source of the depths at which shadows are judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthSource {
    /// The method's own, from the histogram.
    #[default]
    Own,
    /// The ground truth.
    Truth,
}

impl DemultiplexSettings {
    /// Returns an error for fields that the method does not use.
    fn check_method(&self) -> Result<(), SpecError> {
        if self.method == Method::Physics {
            return Ok(());
        }
        let useless = [
            ("histogram", self.histogram != Histogram::default()),
            ("depth", self.depth != DepthSource::default()),
            ("evidence", self.evidence),
        ];
        match useless.iter().find(|(_, given)| *given) {
            Some((field, _)) => Err(SpecError::new(
                format!("demultiplex.{field}"),
                format!(
                    "is for method = \"physics\"; method = {:?} reads the histogram of each spot alone \
                     and finds its own depth; remove it",
                    self.method.name()
                ),
            )),
            None => Ok(()),
        }
    }
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl Declared for DemultiplexTask {
    const NAME: &'static str = "demultiplex";
    const FIELDS: &'static [&'static str] = &["source", "count", "demultiplex", "output"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            demultiplex: fields.or_default("demultiplex")?,
            output: fields.required("output")?,
        })
    }
}

impl TaskKind for DemultiplexTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("demultiplex.version", &self.demultiplex.version),
            source: Some(&self.source),
            makes: Makes::Apart {
                to: &self.output,
                depths: self.demultiplex.depth == DepthSource::Own,
                evidence: self.demultiplex.evidence,
            },
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.demultiplex.version),
            source: Some((&mut self.source, &mut self.count)),
            stores: vec![("output.store", &mut self.output.store)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.demultiplex.check_method()?;
        if self.demultiplex.histogram == Histogram::TransientSpots {
            let what = "\"transient_spots\" has each spot alone, so nothing is multiplexed; expected \"transient\", \
                        \"transient_4\" or \"transient_25\"";
            return Err(SpecError::new("demultiplex.histogram", what));
        }
        let (from, to) = (&self.source, &self.output);
        if (&from.store, &from.dataset) == (&to.store, &to.dataset) {
            let what = format!(
                "{:?} is the source itself; choose another folder for the predictions",
                to.dataset
            );
            return Err(SpecError::new("output.dataset", what));
        }
        if to.profile != default_profile() {
            let what = format!(
                "{:?} is how histograms are coded, and predictions have none; remove it",
                to.profile
            );
            return Err(SpecError::new("output.profile", what));
        }
        to.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "demultiplex",
            "source": self.source.shaping(),
            "settings": self.demultiplex,
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        let pairs = PAIR * source.pixels() * f64::from(source.spots);
        // As the forests see it, as codes, and coded for the store.
        let evidence = match self.demultiplex.evidence {
            true => 3.0 * source.evidence(),
            false => 0.0,
        };
        Some(BASE + source.truth() + (1.0 + RANGES) * source.histogram() + pairs + evidence)
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.count,
            ..Dispatch::default()
        }
    }
}
