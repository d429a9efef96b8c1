//! Splits: divides the scenes of a data set into training, validation and test sets. One task.

use serde::Serialize;
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Manifest, Results, TaskKind},
};
use crate::{
    spec::{
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
    fn io(&self) -> Io<'_> {
        Io {
            version: ("split.version", Self::VERSION),
            source: Some(&self.source),
            makes: Makes::Split(&self.source, &self.split.name),
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

    fn results(&self) -> Results<'_> {
        let (dataset, name) = (&*self.source.dataset, &*self.split.name);
        let folder = format!("{dataset}/split/{name}");
        Results {
            field: "source.store",
            store: &self.source.store,
            folder: folder.clone(),
            destination: Destination::Record(Place {
                field: "split.name",
                store: &self.source.store,
                folder: folder.into(),
            }),
            manifest: Manifest::Split { dataset, name },
        }
    }

    /// Lists of scenes take 64 bytes a scene.
    fn memory(&self, _known: &Known, _threads: u32) -> Option<f64> {
        Some(BASE + 64.0 * self.count as f64)
    }
}
