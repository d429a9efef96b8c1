//! Exports: packs a data set for sharing. One task.

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

/// Name of the ability to write OpenEXR and HDF5, which not every program has.
pub const FORMATS: &str = "formats";

/// Packs a data set: one task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ExportTask {
    /// The data set.
    pub source: SourceSettings,
    /// Number of scenes of the data set.
    pub count: u64,
    /// The selection and the destination.
    pub export: ExportSettings,
}

/// The selection and the destination of an export.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExportSettings {
    /// A path or URL that every worker can reach.
    pub dest: String,
    /// `a..b`, `split:SIDE` or `split:NAME:SIDE`; empty means every scene.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub scenes: String,
    /// `zarr` (default), `sb3d`, `webdataset` or `hdf5`.
    #[serde(default = "zarr")]
    pub format: String,
}

fn zarr() -> String {
    "zarr".into()
}

impl ExportTask {
    /// Version of the task.
    pub const VERSION: &'static str = "export-2";
}

impl Declared for ExportTask {
    const NAME: &'static str = "export";
    const FIELDS: &'static [&'static str] = &["source", "count", "export"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            export: fields.required("export")?,
        })
    }
}

impl TaskKind for ExportTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("export.version", Self::VERSION),
            source: Some(&self.source),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            source: Some((&mut self.source, &mut self.count)),
            stores: vec![("export.dest", &mut self.export.dest)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        match self.export.dest.is_empty() {
            true => Err(SpecError::new(
                "export.dest",
                "is empty; give a path or URL",
            )),
            false => Ok(()),
        }
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": Self::VERSION,
            "source": self.source.shaping(),
            "count": self.count,
            "settings": self.export,
        })
    }

    fn results(&self) -> Results<'_> {
        Results {
            field: "export.dest",
            store: &self.export.dest,
            folder: "/export".into(),
            destination: Destination::folder("export.dest", &self.export.dest, ""),
            manifest: Manifest::None,
        }
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        Some(BASE + source.truth() + 3.5 * source.histogram())
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            variant: matches!(&*self.export.format, "sb3d" | "hdf5").then_some(FORMATS),
            ..Dispatch::default()
        }
    }
}
