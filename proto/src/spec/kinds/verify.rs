//! Verification: reads every scene of a data set and compares it with its manifest. One task a
//! scene. Writes nothing.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut},
    kind::{Declared, Dispatch, Manifest, Results, TaskKind},
};
use crate::spec::{
    destination::Destination,
    limits::check_count,
    memory::{BASE, Known},
    places::{SourceSettings, check_source},
    spec_error::SpecError,
};

/// Verifies a data set: one task a scene, which fails if the scene is damaged.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct VerifyTask {
    /// The data set.
    pub source: SourceSettings,
    /// Number of scenes of the data set.
    pub count: u64,
    /// The thoroughness.
    pub verify: VerifySettings,
}

/// The thoroughness of a verification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VerifySettings {
    /// Whether to check only that each object exists with its size. Otherwise its SHA-256 and
    /// decoding are checked too.
    pub fast: bool,
}

impl VerifyTask {
    /// Version of the task.
    pub const VERSION: &'static str = "verify-1";
}

impl Declared for VerifyTask {
    const NAME: &'static str = "verify";
    const FIELDS: &'static [&'static str] = &["source", "count", "verify"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            verify: fields.or_default("verify")?,
        })
    }
}

impl TaskKind for VerifyTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("verify.version", Self::VERSION),
            source: Some(&self.source),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            source: Some((&mut self.source, &mut self.count)),
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": Self::VERSION,
            "source": self.source.shaping(),
            "settings": self.verify,
        })
    }

    fn results(&self) -> Results<'_> {
        Results {
            field: "source.store",
            store: &self.source.store,
            folder: format!("{}/verify", self.source.dataset),
            destination: Destination::Shared,
            manifest: Manifest::None,
        }
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        Some(BASE + source.truth() + 2.9 * source.histogram())
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.count,
            ..Dispatch::default()
        }
    }
}
