//! Reprocessing: applies a sensor to the histograms of a finished data set and writes another data
//! set. One task a scene. Renders nothing.

use picofarm_settings::{Sensor, SensorError};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Results, TaskKind},
};
use crate::{
    key::hash::StageKey,
    show,
    spec::{
        limits::check_count,
        memory::{BASE, Known, Shape},
        places::{OutputSettings, SourceSettings, check_source},
        spec_error::SpecError,
    },
};

/// Reprocesses a data set into another: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReprocessTask {
    /// The input data set. Its place does not affect the keys of results, which depend on the keys
    /// of its scenes.
    pub source: SourceSettings,
    /// The number of scenes for which the source has room.
    pub count: u64,
    /// The processing of each scene.
    pub reprocess: ReprocessSettings,
    /// The destination of results.
    pub output: OutputSettings,
}

impl Declared for ReprocessTask {
    const NAME: &'static str = "reprocess";
    const FIELDS: &'static [&'static str] = &["source", "count", "reprocess", "output"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            reprocess: fields.or_default("reprocess")?,
            output: fields.required("output")?,
        })
    }
}

impl TaskKind for ReprocessTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("reprocess.version", &self.reprocess.version),
            source: Some(&self.source),
            makes: Makes::Scenes(&self.output),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.reprocess.version),
            source: Some((&mut self.source, &mut self.count)),
            stores: vec![("output.store", &mut self.output.store)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        let (from, to) = (&self.source, &self.output);
        if (&from.store, &from.dataset) == (&to.store, &to.dataset) {
            let what = format!(
                "{:?} is the source itself; choose another data set for the results",
                to.dataset
            );
            return Err(SpecError::new("output.dataset", what));
        }
        self.reprocess.check(&to.profile)?;
        to.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "reprocess",
            "source": self.source.shaping(),
            "settings": self.reprocess.stage_key(&self.output.profile).to_string(),
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        let spots = self.reprocess.histogram == Histogram::TransientSpots;
        // Includes the memory of the previous scene that the allocator still keeps.
        let histograms = if spots { 5.6 } else { 4.2 };
        // The sensor may have more bins than the source.
        let own = self.reprocess.sensor.gate.map_or(0, |gate| gate.bins);
        let more = (f64::from(own) / f64::from(source.bins.max(1))).max(1.0);
        Some(BASE + source.truth() + histograms * more * source.histogram())
    }

    fn shape(&self, source: Option<Shape>) -> Option<Shape> {
        let source = source?;
        let spots = match self.reprocess.histogram {
            Histogram::Transient => source.spots,
            Histogram::Transient4 => 4,
            Histogram::Transient25 => 25,
            Histogram::TransientSpots => self.reprocess.spots.len() as u32,
        };
        Some(Shape {
            bins: self.reprocess.sensor.bins(source.bins),
            spots,
            ..source
        })
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.count,
            ..Dispatch::default()
        }
    }
}

/// The processing of each scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReprocessSettings {
    /// Histogram of the scene.
    pub histogram: Histogram,
    /// Only these spots, summed (multiplexing). Requires `histogram = "transient_spots"`, which in
    /// turn requires it; ascending.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// The sensor.
    pub sensor: Sensor,
    /// Whether bins that `sensor.rebin` leaves over at the end of the gate are dropped. Otherwise
    /// it must divide the number of bins.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub drop_left_over: bool,
    /// Whether photon counts get the sensor's pulse, scale and noise on top of their own.
    /// Otherwise such a sensor is refused for photon counts.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub on_counts: bool,
    /// Selects another draw of the same noise (default 0).
    pub seed: u64,
    /// Version of the sensor model and the encoder, part of every task key; filled in at submission
    /// if omitted.
    pub version: String,
}

/// The histograms that a data set may have, by the names of their arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Histogram {
    /// All spots together.
    #[default]
    Transient,
    /// 4 of the 100 spots.
    #[serde(rename = "transient_4")]
    Transient4,
    /// 25 of the 100 spots.
    #[serde(rename = "transient_25")]
    Transient25,
    /// Each spot alone; [`ReprocessSettings::spots`] are summed.
    TransientSpots,
}

impl Histogram {
    /// All histograms.
    pub const ALL: [Self; 4] = [
        Self::Transient,
        Self::Transient4,
        Self::Transient25,
        Self::TransientSpots,
    ];

    /// Returns the name of the array.
    pub fn name(self) -> &'static str {
        match self {
            Self::Transient => "transient",
            Self::Transient4 => "transient_4",
            Self::Transient25 => "transient_25",
            Self::TransientSpots => "transient_spots",
        }
    }

    /// Returns the histogram with this name.
    ///
    /// # Errors
    /// Returns a message that lists the valid names.
    pub fn parse(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|h| h.name() == name);
        found.ok_or_else(|| show::unknown(name, &Self::ALL.map(Self::name)))
    }
}

impl ReprocessSettings {
    /// Returns the stage key of a reprocess stage. It excludes the places of source and target,
    /// because those follow from the keys of the source's scenes ([`crate::key::derived_key`]).
    pub fn stage_key(&self, profile: &str) -> StageKey {
        let description = json!({
            "task": "reprocess",
            "histogram": self.histogram,
            "spots": self.spots,
            "sensor": serde_json::to_value(&self.sensor).expect("settings are plain data"),
            "drop_left_over": self.drop_left_over,
            "seed": self.seed,
            "version": self.version,
            "profile": profile,
        });
        StageKey::of(description)
    }

    /// Returns the codec profile without relevant loss: whole counts are kept exactly, rates to a
    /// fraction of the photon noise.
    pub fn natural_profile(&self) -> &'static str {
        if self.sensor.poisson {
            "counts-u16"
        } else {
            "sqrt-u16"
        }
    }

    /// Sorts the spots, because the order in which they are written must not affect the results.
    pub fn normalise(&mut self) {
        self.spots.sort_unstable();
    }

    /// Checks every field against its limits, and the target's codec profile against the sensor.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self, profile: &str) -> Result<(), SpecError> {
        let fail =
            |field: &str, what: String| Err(SpecError::new(format!("reprocess.{field}"), what));
        if self.histogram == Histogram::TransientSpots && self.spots.is_empty() {
            return fail(
                "spots",
                "is empty; name the spots to sum, or take histogram = \"transient\" for all".into(),
            );
        }
        if self.histogram != Histogram::TransientSpots && !self.spots.is_empty() {
            return fail(
                "spots",
                format!(
                    "are summed from histogram = \"transient_spots\"; remove them from histogram = {:?}",
                    self.histogram.name()
                ),
            );
        }
        if !self.spots.is_sorted_by(|a, b| a < b) {
            return fail(
                "spots",
                format!("{:?} must name each once, ascending", self.spots),
            );
        }
        self.sensor.check().map_err(|e| {
            let SensorError::Invalid { field, what } = e;
            SpecError::new(format!("reprocess.{field}"), what)
        })?;
        if profile == "counts-u16" && !self.sensor.poisson {
            return Err(SpecError::new(
                "output.profile",
                "\"counts-u16\" holds whole counts, but reprocess.sensor.poisson = false gives rates; use \"sqrt-u16\" \
                 or \"lossless\"",
            ));
        }
        Ok(())
    }
}
