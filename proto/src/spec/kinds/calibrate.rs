//! Calibration: checks a measured scene, and writes it with its calibration corrected: gate, laser,
//! spots, focal length, order of spots, dead and hot pixels. One task.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Results, TaskKind},
};
use crate::{
    key::hash::StageKey,
    spec::{
        limits::check_count,
        memory::{BASE, Known, Shape},
        places::{OutputSettings, SourceSettings, check_source},
        spec_error::SpecError,
    },
};

/// Corrects the calibration of a data set of one scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CalibrateTask {
    /// The input data set. Its place does not affect the keys of results, which depend on the keys
    /// of its scenes.
    pub source: SourceSettings,
    /// The number of scenes for which the source has room.
    pub count: u64,
    /// What is accepted.
    pub calibrate: CalibrateSettings,
    /// The destination of results.
    pub output: OutputSettings,
}

/// What a calibration accepts.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrateSettings {
    /// The number of laser pulses in each histogram, if known: pile-up is corrected with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pulses: Option<u64>,
    /// Whether a scene that no correction explains, or that shows too little, passes with its
    /// calibration unchanged. Otherwise its task fails.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub accept_unexplained: bool,
    /// Version of the method and the encoder, part of every task key; filled in at submission if
    /// omitted.
    pub version: String,
}

impl CalibrateSettings {
    /// Returns the stage key of a calibration. It excludes the places of source and target, because
    /// those follow from the keys of the source's scenes ([`crate::key::derived_key`]).
    pub fn stage_key(&self, profile: &str) -> StageKey {
        StageKey::of(json!({"task": "calibrate", "settings": self, "profile": profile}))
    }
}

impl Declared for CalibrateTask {
    const NAME: &'static str = "calibrate";
    const FIELDS: &'static [&'static str] = &["source", "count", "calibrate", "output"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            calibrate: fields.or_default("calibrate")?,
            output: fields.required("output")?,
        })
    }
}

impl TaskKind for CalibrateTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("calibrate.version", &self.calibrate.version),
            source: Some(&self.source),
            makes: Makes::Scenes(&self.output),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.calibrate.version),
            source: Some((&mut self.source, &mut self.count)),
            stores: vec![("output.store", &mut self.output.store)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        if self.count > 1 {
            let what = format!(
                "has room for {} scenes, expected 1: a data set has one gate, and each scene gets one of its own; import \
                 each capture into a data set of its own (import.scenes = [\"NAME\"])",
                self.count
            );
            return Err(SpecError::new("source", what));
        }
        if self.calibrate.pulses == Some(0) {
            let what = "is 0, expected the number of laser pulses in a histogram, such as 1000000; leave it out if it is \
                        unknown";
            return Err(SpecError::new("calibrate.pulses", what));
        }
        let (from, to) = (&self.source, &self.output);
        if (&from.store, &from.dataset) == (&to.store, &to.dataset) {
            let what = format!(
                "{:?} is the source itself; choose another data set for the results",
                to.dataset
            );
            return Err(SpecError::new("output.dataset", what));
        }
        to.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "calibrate",
            "source": self.source.shaping(),
            "settings": self.calibrate.stage_key(&self.output.profile).to_string(),
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        // The histograms of each spot: as read, without pile-up, summed to wider bins, corrected,
        // and coded; and their sum.
        let spots = 4.5 * f64::from(source.spots);
        Some(BASE + source.truth() + (4.0 + spots) * source.histogram())
    }

    fn shape(&self, source: Option<Shape>) -> Option<Shape> {
        source
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.count,
            ..Dispatch::default()
        }
    }
}
