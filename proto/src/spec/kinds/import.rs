//! Imports: converts scenes of other formats into a data set. One task a scene.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Results, TaskKind},
};
use crate::spec::{
    limits::MAX_TASKS,
    memory::{BASE, Known},
    places::OutputSettings,
    spec_error::SpecError,
};

/// Imports scenes into a data set: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImportTask {
    /// The scenes and the way to read them.
    pub import: ImportSettings,
    /// The destination of results.
    pub output: OutputSettings,
}

/// The scenes and the way to read them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImportSettings {
    /// The folder with the files, as seen by the workers.
    pub folder: String,
    /// The layout of the files; filled in at submission if omitted.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub format: String,
    /// Values that override the files, by name. The importer defines the names.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub options: Map<String, Value>,
    /// Names of the scenes, in the order of their indices; filled in at submission if omitted (all
    /// of them).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub scenes: Vec<String>,
    /// Index of the first listed scene: 0 except in a lease, which contains only its own.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub first: u64,
    /// Number of scenes, derived from the list.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub count: u64,
    /// Version of the importer, part of every task key; filled in at submission if omitted.
    #[serde(default)]
    pub version: String,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

impl ImportSettings {
    /// Returns the name of scene `index`, if it is listed.
    pub fn name(&self, index: u64) -> Option<&str> {
        let at = usize::try_from(index.checked_sub(self.first)?).ok()?;
        self.scenes.get(at).map(String::as_str)
    }
}

impl Declared for ImportTask {
    const NAME: &'static str = "import";
    const FIELDS: &'static [&'static str] = &["import", "output"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            import: fields.required("import")?,
            output: fields.required("output")?,
        })
    }

    fn only(&self, lo: u64, hi: u64) -> Option<Self> {
        let import = &self.import;
        let at = |i: u64| usize::try_from(i.saturating_sub(import.first)).unwrap_or(usize::MAX);
        let own = import.scenes.get(at(lo)..at(hi).min(import.scenes.len()));
        Some(Self {
            import: ImportSettings {
                folder: import.folder.clone(),
                format: import.format.clone(),
                options: import.options.clone(),
                scenes: own.unwrap_or_default().to_vec(),
                first: lo.max(import.first),
                count: import.count,
                version: import.version.clone(),
            },
            output: self.output.clone(),
        })
    }
}

impl TaskKind for ImportTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("import.version", &self.import.version),
            files: Some(("import.folder", &self.import.folder)),
            makes: Makes::Scenes(&self.output),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.import.version),
            stores: vec![("output.store", &mut self.output.store)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        let import = &self.import;
        let fail = |field: &str, what: String| Err(SpecError::new(format!("import.{field}"), what));
        if import.folder.is_empty() {
            return fail("folder", "is empty; give the folder with the files".into());
        }
        if import.first != 0 {
            return fail("first", "is only for leases; remove it".into());
        }
        let listed = import.scenes.len() as u64;
        if listed == 0 || listed > MAX_TASKS {
            return fail(
                "scenes",
                format!("lists {listed} scenes, expected 1 to {MAX_TASKS}"),
            );
        }
        if import.count != listed {
            let what = format!(
                "{} differs from the {listed} scenes listed; leave it out",
                import.count
            );
            return fail("count", what);
        }
        self.output.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "import",
            "import": self.import,
            "profile": self.output.profile,
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        Some(BASE + source.truth() + 3.2 * source.histogram())
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.import.count,
            ..Dispatch::default()
        }
    }
}
