//! Verification: reads every scene of a data set and compares it with its manifest. One task a
//! scene. Writes nothing.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    kind::{Declared, Manifest, Results, TaskKind},
};
use crate::model::{
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
    fn versioned(&self) -> (&'static str, &str) {
        ("verify.version", Self::VERSION)
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

    fn destination(&self) -> Destination<'_> {
        Destination::Shared
    }

    fn results(&self) -> Results<'_> {
        Results {
            field: "source.store",
            store: &self.source.store,
            folder: format!("{}/verify", self.source.dataset),
            manifest: Manifest::None,
        }
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        Some(BASE + source.truth() + 2.9 * source.histogram())
    }

    fn tasks(&self) -> u64 {
        self.count
    }

    fn reads(&self) -> Option<&SourceSettings> {
        Some(&self.source)
    }

    fn reads_mut(&mut self) -> Option<(&mut SourceSettings, &mut u64)> {
        Some((&mut self.source, &mut self.count))
    }
}
