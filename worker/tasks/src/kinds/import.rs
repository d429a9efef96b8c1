//! Import: copies a scene of a foreign data set into a data set. See [`picofarm_exchange::import`]
//! for the checks.

use std::{path::Path, sync::Arc};

use picofarm_dataset::{DatasetSpec, Profile};
use picofarm_exchange::import::{
    Format, IMPORT_VERSION, ImportError, ImportOptions, Source, import_scene,
};
use picofarm_files::{FileError, Opener};
use picofarm_proto::spec::{ImportSettings, ImportTask, SpecError, TaskSpec};
use picofarm_results::Verdict;
use picofarm_store::published::Manifest as _;
use tracing::info;

use crate::{
    errors::dataset_error,
    stores::{manifest_sha256, saying},
    submission::Submission,
    task::{Context, Control, Latest, Output, RunTask, Task, TaskError},
};

/// Returns the version of all code of this program that determines an imported scene's bytes.
pub fn import_version() -> String {
    format!("{IMPORT_VERSION}/{}", picofarm_dataset::ENCODER_VERSION)
}

/// Returns the format that import settings name, if any, and their options.
///
/// # Errors
/// Returns an error naming the field if a name is unknown or a value is invalid.
fn import_options(settings: &ImportSettings) -> Result<(Option<Format>, ImportOptions), SpecError> {
    let parsed = |name| Format::parse(name).map_err(|e| SpecError::new("import.format", e));
    let format = match settings.format.is_empty() {
        true => None,
        false => Some(parsed(&settings.format)?),
    };
    let options = serde_json::Value::Object(settings.options.clone());
    let options = serde_json::from_value(options)
        .map_err(|e| SpecError::new("import.options", e.to_string()))?;
    Ok((format, options))
}

/// Opens the source of scene `name`, and returns it with the scene's index in it.
fn open(
    latest: &Latest<Option<(ImportSettings, Arc<Source>)>>,
    settings: &ImportSettings,
    name: &str,
    files: &Opener,
) -> Result<(Arc<Source>, u64), TaskError> {
    let key = ImportSettings {
        scenes: vec![],
        first: 0,
        ..settings.clone()
    };
    if let Some((opened, source)) = latest.get()
        && opened == key
        && let Some(index) = source.index_of(name)
    {
        return Ok((source, index));
    }
    let (format, options) = import_options(settings).map_err(|e| TaskError::User(e.to_string()))?;
    let folder = Path::new(&settings.folder);
    let source = Source::open_within(folder, format, options, None, files);
    let source = Arc::new(source.map_err(of_import)?);
    let Some(index) = source.index_of(name) else {
        return Err(TaskError::User(format!(
            "import.scenes: {} has no scene {name:?} any more; put it back, or submit the job again",
            settings.folder
        )));
    };
    latest.set(Some((key, source.clone())));
    Ok((source, index))
}

impl RunTask for ImportTask {
    fn code_version() -> String {
        import_version()
    }

    /// Imports scene `task.index` of the job.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, files, spec) = (&context.stores, &context.files, self);
        let (settings, place) = (&spec.import, &spec.output);
        let Some(name) = settings.name(task.index) else {
            let what = format!(
                "import.scenes: lists no scene {}; submit the job again",
                task.index
            );
            return Err(TaskError::User(what));
        };
        let profile = Profile::parse(&place.profile)
            .map_err(|e| TaskError::User(format!("output.profile: {e}")))?;
        let (source, index) = open(&context.source, settings, name, files)?;
        let described = DatasetSpec {
            scenes: settings.count,
            ..source.spec(profile)
        };
        stores.fits(TaskSpec::Import(spec.clone()), Some(&described))?;
        let dataset = stores.create_or_open(&place.store, &place.dataset, &described, control)?;
        if !task.spec.force {
            let found = source.finished(&dataset, task.index, index, false);
            if let Some(manifest) = stores.wait_for(control, found, of_import)? {
                return Ok(Output {
                    manifest_sha256: manifest_sha256(&manifest),
                    bytes: manifest.total_bytes(),
                    adopted: true,
                });
            }
        }
        let scene = import_scene(&source, index).map_err(of_import)?;
        info!(scene = scene.name, missing = ?scene.missing, "scene read");
        saying(&Verdict::of_import(&scene.check), &scene.name);
        if !control.at(0.6) {
            return Err(TaskError::Stopped);
        }
        let encoded = source
            .encode(&dataset, task.index, &scene)
            .map_err(of_import)?;
        control.at(0.9);
        let manifest = stores.publish(&dataset, encoded, control)?;
        control.at(1.0);
        Ok(Output {
            manifest_sha256: manifest_sha256(&manifest),
            bytes: manifest.total_bytes(),
            adopted: false,
        })
    }

    /// The names of the scenes are read from the folder.
    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        here.profile(&self.output.profile)?;
        let import = &mut self.import;
        let (format, options) = import_options(import)?;
        let folder = here.path("import.folder", &import.folder)?;
        let names = (!import.scenes.is_empty()).then_some(&import.scenes[..]);
        let source = Source::open(&folder, format, options, names)
            .map_err(|e| SpecError::new("import.folder", e.to_string()))?;
        import.folder = folder.display().to_string();
        import.format = source.format().name().to_owned();
        import.scenes = (0..source.scenes())
            .filter_map(|i| source.name(i).map(str::to_owned))
            .collect();
        import.count = source.scenes();
        Ok(())
    }
}

/// Classifies an import error: a failing disk is not the job's fault, everything else is.
fn of_import(error: ImportError) -> TaskError {
    use std::io::ErrorKind::{
        InvalidInput, IsADirectory, NotADirectory, NotFound, PermissionDenied,
    };
    let text = error.to_string();
    match error {
        ImportError::Dataset(error) => dataset_error(error),
        ImportError::Io { source, .. }
        | ImportError::File {
            error: FileError::Io { source, .. },
        } => match source.kind() {
            NotFound | NotADirectory | IsADirectory | PermissionDenied | InvalidInput => {
                TaskError::User(format!("{text}; every worker must see it under this path"))
            }
            _ => TaskError::Interrupted(text),
        },
        _ => TaskError::User(text),
    }
}
