//! Importing: a scene of other people's data into a data set. See [`picofarm_dataset::import`] for what is checked.

use std::{
    path::Path,
    sync::{Arc, Mutex},
};

use picofarm_dataset::{
    DatasetSpec, Profile,
    import::{Format, IMPORT_VERSION, ImportError, ImportOptions, Source, import_scene},
};
use picofarm_proto::model::{ImportSettings, ImportTask};
use tracing::info;

use super::{
    Control, Output, Task, TaskError,
    output::{Stores, manifest_sha256, of_dataset},
};

/// Everything of this program that decides an imported scene's bytes.
pub fn import_version() -> String {
    format!("{IMPORT_VERSION}/{}", picofarm_dataset::ENCODER_VERSION)
}

/// The format of import settings, if they name one, and their options.
///
/// # Errors
/// An unknown name or a value that cannot be, by field.
pub fn import_options(
    settings: &ImportSettings,
) -> Result<(Option<Format>, ImportOptions), String> {
    let format = match settings.format.is_empty() {
        true => None,
        false => Some(Format::parse(&settings.format).map_err(|e| format!("import.format: {e}"))?),
    };
    let options = serde_json::Value::Object(settings.options.clone());
    let options = serde_json::from_value(options).map_err(|e| format!("import.options: {e}"))?;
    Ok((format, options))
}

/// The source read last: a folder of many scenes is looked through once.
#[derive(Default)]
pub(super) struct Sources(Mutex<Option<(ImportSettings, Arc<Source>)>>);

impl Sources {
    /// The source that holds scene `name`, and the scene's index in it.
    fn open(&self, settings: &ImportSettings, name: &str) -> Result<(Arc<Source>, u64), TaskError> {
        let key = ImportSettings {
            scenes: vec![],
            first: 0,
            ..settings.clone()
        };
        let known = || self.0.lock().expect("no panic while locked");
        if let Some((of, source)) = &*known()
            && *of == key
            && let Some(index) = source.index_of(name)
        {
            return Ok((source.clone(), index));
        }
        let (format, options) = import_options(settings).map_err(TaskError::User)?;
        let folder = Path::new(&settings.folder);
        let source = Arc::new(Source::open(folder, format, options, None).map_err(of_import)?);
        let Some(index) = source.index_of(name) else {
            return Err(TaskError::User(format!(
                "import.scenes: {} has no scene {name:?} any more; put it back, or submit the job again",
                settings.folder
            )));
        };
        *known() = Some((key, source.clone()));
        Ok((source, index))
    }
}

/// Imports scene `task.index` of `spec`.
pub(super) fn run(
    stores: &Stores,
    sources: &Sources,
    spec: &ImportTask,
    task: &Task,
    control: &Control,
) -> Result<Output, TaskError> {
    let (settings, place) = (&spec.import, &spec.output);
    let ours = import_version();
    if settings.version != ours {
        return Err(TaskError::User(format!(
            "import.version: the job asks for {:?}, this worker has {ours:?}; submit the job again with this version, or \
             run workers of the other one",
            settings.version
        )));
    }
    let Some(name) = settings.name(task.index) else {
        let what = format!(
            "import.scenes: lists no scene {}; submit the job again",
            task.index
        );
        return Err(TaskError::User(what));
    };
    let profile = Profile::parse(&place.profile)
        .map_err(|e| TaskError::User(format!("output.profile: {e}")))?;
    let (source, index) = sources.open(settings, name)?;
    let described = DatasetSpec {
        scenes: settings.count,
        ..source.spec(profile)
    };
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

/// Who is to blame: a disk that fails is nobody's fault, everything else is the job's.
fn of_import(error: ImportError) -> TaskError {
    use std::io::ErrorKind::{IsADirectory, NotADirectory, NotFound, PermissionDenied};
    let text = error.to_string();
    match error {
        ImportError::Dataset(error) => of_dataset(error),
        ImportError::Io { source, .. } => match source.kind() {
            NotFound | NotADirectory | IsADirectory | PermissionDenied => {
                TaskError::User(format!("{text}; every worker must see it under this path"))
            }
            _ => TaskError::Interrupted(text),
        },
        _ => TaskError::User(text),
    }
}
