//! Splits: divides the scenes of a data set into training, validation and test sets. One task.

use serde::Serialize;
use serde_json::{Value, json};

use super::{
    fields::Fields,
    kind::{Declared, Manifest, Results, TaskKind},
};
use crate::{
    model::{
        destination::{Destination, Place},
        limits::check_count,
        memory::{BASE, Known},
        places::{SourceSettings, check_source},
        spec_error::SpecError,
    },
    split::SplitSettings,
};

/// Divides a data set: one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SplitTask {
    /// The data set.
    pub source: SourceSettings,
    /// Number of scenes of the data set.
    pub count: u64,
    /// Settings of the split.
    pub split: SplitSettings,
}

impl SplitTask {
    /// Version of the task.
    pub const VERSION: &'static str = "split-1";
}

impl Declared for SplitTask {
    const NAME: &'static str = "split";
    const FIELDS: &'static [&'static str] = &["source", "count", "split"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            split: fields.required("split")?,
        })
    }
}

impl TaskKind for SplitTask {
    fn versioned(&self) -> (&'static str, &str) {
        ("split.version", Self::VERSION)
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.split.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": Self::VERSION,
            "source": self.source.shaping(),
            "count": self.count,
            "settings": self.split,
        })
    }

    fn destination(&self) -> Destination<'_> {
        let folder = format!("{}/split/{}", self.source.dataset, self.split.name);
        Destination::Record(Place {
            field: "split.name",
            store: &self.source.store,
            folder: folder.into(),
        })
    }

    fn results(&self) -> Results<'_> {
        let (dataset, name) = (&*self.source.dataset, &*self.split.name);
        Results {
            field: "source.store",
            store: &self.source.store,
            folder: format!("{dataset}/split/{name}"),
            manifest: Manifest::Split { dataset, name },
        }
    }

    /// Lists of scenes take 64 bytes a scene.
    fn memory(&self, _known: &Known, _threads: u32) -> Option<f64> {
        Some(BASE + 64.0 * self.count as f64)
    }

    fn reads(&self) -> Option<&SourceSettings> {
        Some(&self.source)
    }

    fn reads_mut(&mut self) -> Option<(&mut SourceSettings, &mut u64)> {
        Some((&mut self.source, &mut self.count))
    }

    fn divides(&self) -> Option<(&SourceSettings, &String)> {
        Some((&self.source, &self.split.name))
    }
}
