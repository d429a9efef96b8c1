//! Job files: reading, and resolving what a submission must pin (furniture,
//! scene files' content, renderer version, absolute store).

use std::path::{Component, Path, PathBuf};

use picofarm_dataset::import::Source;
use picofarm_proto::{
    key::render_stage_key,
    model::{ImportTask, JobSpec, RenderTask, SceneKind, TaskSpec, scaled},
};

use crate::{
    assets,
    error::{CliError, Code, Result, io},
};

/// Reads a job file and pins everything a submission needs but the number of scenes of data sets that exist.
#[cfg(test)]
fn read(path: &Path, asset_dir: &Path) -> Result<JobSpec> {
    checked(read_uncounted(path, None, asset_dir)?, path)
}

fn checked(spec: JobSpec, path: &Path) -> Result<JobSpec> {
    let checked = spec.check().and_then(|()| spec.check_places());
    checked.map_err(|e| CliError::input(format!("{}: {e}", path.display())))?;
    Ok(spec)
}

fn read_uncounted(path: &Path, scale: Option<&str>, asset_dir: &Path) -> Result<JobSpec> {
    let text = std::fs::read_to_string(path).map_err(|e| io(path.display(), &e))?;
    let failed = |e: &dyn std::fmt::Display| {
        CliError::input(format!("{}: {}", path.display(), e.to_string().trim_end()))
            .hint("`picofarm job init` writes a job file with every field explained")
    };
    // Read as it stands where it may be, because then errors name the line.
    let table: toml::Table = toml::from_str(&text).map_err(|e| failed(&e))?;
    let spec: JobSpec = if scale.is_some() || table.contains_key("scale") {
        let value = serde_json::to_value(&table).map_err(|e| failed(&e))?;
        let value = scaled(value, scale).map_err(|e| failed(&e))?;
        serde_json::from_value(value).map_err(|e| failed(&e))?
    } else {
        toml::from_str(&text).map_err(|e| failed(&e))?
    };
    let base = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    resolve(spec, base, asset_dir).map_err(|e| CliError {
        message: format!("{}: {}", path.display(), e.message),
        ..e
    })
}

/// Reads a job file and pins everything a submission needs. The number of scenes of data sets that exist, where the file
/// does not say it, is asked of their stores. Of a file that has several sizes, `scale` is meant.
///
/// # Errors
/// Input errors that name the file, the field and what was expected; a data set that cannot be opened.
pub async fn read_counted(path: &Path, scale: Option<&str>, asset_dir: &Path) -> Result<JobSpec> {
    let mut spec = read_uncounted(path, scale, asset_dir)?;
    for stage in &mut spec.stages {
        if let Some((source, count)) = stage.task.reads_mut()
            && *count == 0
        {
            let failed = |e: picofarm_dataset::DatasetError| {
                CliError::input(format!(
                    "{}: stage {:?}: source: {e}",
                    path.display(),
                    stage.name
                ))
                .hint("give the number of its scenes as `count`, or make the data set first")
            };
            let (store, prefix) = picofarm_dataset::open_store(&source.store).map_err(failed)?;
            let dataset = picofarm_dataset::Dataset::open(store, prefix.join(&*source.dataset));
            *count = dataset.await.map_err(failed)?.spec().scenes;
        }
    }
    checked(spec, path)
}

/// Pins furniture, file contents, versions and absolute places.
///
/// # Errors
/// A field out of its limits, a store that cannot be one, a missing file, or furniture that is not installed.
fn resolve(mut spec: JobSpec, base: &Path, asset_dir: &Path) -> Result<JobSpec> {
    let several = spec.stages.len() > 1;
    for stage in &mut spec.stages {
        let named = |e: CliError| match several {
            true => CliError {
                message: format!("stage {:?}: {}", stage.name, e.message),
                ..e
            },
            false => e,
        };
        if let Some((source, _)) = stage.task.reads_mut() {
            source.store = store(base, &source.store, "source.store").map_err(named)?;
        }
        match &mut stage.task {
            TaskSpec::Render(task) => {
                *task = resolve_render(task.clone(), base, asset_dir).map_err(named)?;
            }
            TaskSpec::Generate(task) => {
                let settings = &mut task.generate;
                settings.dest = store(base, &settings.dest, "generate.dest").map_err(named)?;
                let version = picofarm_agent::generator_version();
                pin(&mut settings.version, version, "generate.version").map_err(named)?;
                if let SceneKind::Furnished { assets: name, .. } = &mut task.scenes.kind {
                    *name = assets::resolve(name, asset_dir).map_err(named)?;
                }
            }
            TaskSpec::Import(task) => resolve_import(task, base).map_err(named)?,
            TaskSpec::Part(task) => {
                task.whole = resolve_render(task.whole.clone(), base, asset_dir).map_err(named)?;
                task.joined_by = render_stage_key(&task.whole).to_string();
            }
            TaskSpec::Reprocess(task) => {
                task.output.store =
                    store(base, &task.output.store, "output.store").map_err(named)?;
                task.reprocess.normalise();
                let version = picofarm_agent::reprocess::sensor_version();
                let asked = &mut task.reprocess.version;
                pin(asked, version, "reprocess.version").map_err(named)?;
                profile(&task.output.profile).map_err(named)?;
                picofarm_agent::reprocess::sensor(&task.reprocess.sensor)
                    .map_err(|e| named(CliError::input(e.to_string())))?;
            }
            TaskSpec::Split(_) => {}
            TaskSpec::Train(task) => {
                let version = picofarm_agent::model_version();
                pin(&mut task.train.version, version, "train.version").map_err(named)?;
            }
            TaskSpec::Evaluate(task) => {
                let version = picofarm_agent::model_version();
                let asked = &mut task.evaluate.version;
                pin(asked, version, "evaluate.version").map_err(named)?;
            }
            TaskSpec::Promote(task) => {
                let version = picofarm_agent::model_version();
                let asked = &mut task.promote.version;
                pin(asked, version, "promote.version").map_err(named)?;
            }
            TaskSpec::Infer(task) => {
                task.output.store =
                    store(base, &task.output.store, "output.store").map_err(named)?;
                let version = picofarm_agent::infer_version();
                let asked = &mut task.infer.version;
                pin(asked, version, "infer.version").map_err(named)?;
            }
            TaskSpec::Report(task) => {
                let report = &mut task.report;
                report.store = store(base, &report.store, "report.store").map_err(named)?;
                let version = picofarm_agent::model_version();
                pin(&mut report.version, version, "report.version").map_err(named)?;
            }
            TaskSpec::Export(task) => {
                task.export.dest = store(base, &task.export.dest, "export.dest").map_err(named)?;
                picofarm_dataset::ExportFormat::parse(&task.export.format)
                    .map_err(|e| named(CliError::input(format!("export.format: {e}"))))?;
                picofarm_agent::export::Scenes::parse(&task.export.scenes)
                    .map_err(|e| named(CliError::input(format!("export.scenes: {e}"))))?;
            }
        }
    }
    // What reads an import knows its number of scenes only now.
    spec.resolve()?;
    Ok(spec)
}

/// The same for one rendering.
///
/// # Errors
/// As [`read_counted`].
pub fn resolve_render(mut task: RenderTask, base: &Path, asset_dir: &Path) -> Result<RenderTask> {
    let renderer = picofarm_agent::renderer_version();
    pin(&mut task.render.renderer, renderer, "render.renderer")?;
    task.check()?;
    picofarm_agent::strategy(&task.render.strategy)
        .map_err(|e| CliError::input(format!("render.strategy: {e}")))?;
    profile(&task.output.profile)?;
    task.output.store = store(base, &task.output.store, "output.store")?;
    match &mut task.scenes.kind {
        SceneKind::Furnished { assets: name, .. } => *name = assets::resolve(name, asset_dir)?,
        SceneKind::Primitive => {}
        SceneKind::Files { files, .. } => {
            for (i, file) in files.iter_mut().enumerate() {
                let path = absolute(base, &file.path)?;
                let hash = picofarm_scene::import::fingerprint(&path)
                    .map_err(|e| CliError::input(format!("scenes.files[{i}]: {e}")))?;
                if !file.sha256.is_empty() && file.sha256 != hash {
                    return Err(CliError::input(format!(
                        "scenes.files[{i}]: {} has SHA-256 {hash}, the job says {}",
                        path.display(),
                        file.sha256
                    )));
                }
                file.sha256 = hash;
                file.path = path.display().to_string();
            }
        }
    }
    Ok(task)
}

/// The same for one import: which scenes there are is asked of the folder.
fn resolve_import(task: &mut ImportTask, base: &Path) -> Result<()> {
    task.output.store = store(base, &task.output.store, "output.store")?;
    profile(&task.output.profile)?;
    let import = &mut task.import;
    let version = picofarm_agent::import_version();
    pin(&mut import.version, version, "import.version")?;
    let (format, options) = picofarm_agent::import_options(import).map_err(CliError::input)?;
    let folder = absolute(base, &import.folder)?;
    let names = (!import.scenes.is_empty()).then_some(&import.scenes[..]);
    let source = Source::open(&folder, format, options, names)
        .map_err(|e| CliError::input(format!("import.folder: {e}")))?;
    import.folder = folder.display().to_string();
    import.format = source.format().name().to_owned();
    import.scenes = (0..source.scenes())
        .filter_map(|i| source.name(i).map(str::to_owned))
        .collect();
    import.count = source.scenes();
    Ok(())
}

/// Fills in this program's version, or checks that it is the one asked for.
fn pin(asked: &mut String, ours: String, field: &str) -> Result<()> {
    if !asked.is_empty() && *asked != ours {
        return Err(CliError::input(format!(
            "{field}: this program has {ours:?}, the job asks for {asked:?}"
        ))
        .hint("leave the field out, or use the picofarm version that made the data set"));
    }
    *asked = ours;
    Ok(())
}

fn profile(name: &str) -> Result<()> {
    picofarm_dataset::Profile::parse(name)
        .map(|_| ())
        .map_err(|e| CliError::input(format!("output.profile: {e}")))
}

/// A store's place, absolute.
fn store(base: &Path, text: &str, field: &str) -> Result<String> {
    let place = match text.is_empty() || text.contains("://") {
        true => text.to_owned(),
        false => absolute(base, text)?.display().to_string(),
    };
    if !place.is_empty() {
        picofarm_dataset::check_location(&place)
            .map_err(|e| CliError::input(format!("{field}: {e}")))?;
    }
    Ok(place)
}

/// The place that `path` means in `base`, without `.` and `..`.
fn absolute(base: &Path, path: &str) -> Result<PathBuf> {
    let whole = std::path::absolute(base.join(path))
        .map_err(|e| CliError::new(Code::Input, format!("{path:?}: {e}")))?;
    let mut plain = PathBuf::new();
    for part in whole.components() {
        if part == Component::ParentDir {
            // The folder above a link's target is not the one above the link.
            plain = plain.canonicalize().unwrap_or(plain);
            plain.pop();
        } else {
            plain.push(part);
        }
    }
    Ok(plain)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{args::JobKind, template::template};

    fn written(dir: &Path, text: &str) -> PathBuf {
        let path = dir.join("job.toml");
        std::fs::write(&path, text).unwrap();
        path
    }

    #[test]
    fn every_template_reads_back() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(
            dir.path().join("scene.glb"),
            br#"{"asset":{"version":"2.0"}}"#,
        )
        .unwrap();
        for kind in [
            JobKind::Furnished,
            JobKind::Primitive,
            JobKind::Files,
            JobKind::Graph,
            JobKind::Train,
            JobKind::Sweep,
        ] {
            let path = written(dir.path(), &template(kind));
            let spec = read(&path, dir.path()).unwrap();
            let store = spec.stages[0].task.writes().unwrap().0;
            assert!(Path::new(store).is_absolute());
        }
    }

    #[test]
    fn every_experiment_is_a_job_at_both_sizes() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/experiments");
        let mut files = 0;
        for file in std::fs::read_dir(&folder).unwrap() {
            let path = file.unwrap().path();
            for scale in ["mini", "paper"] {
                // Rooms of furniture need its assets; their kind is all that differs.
                let text = std::fs::read_to_string(&path).unwrap();
                let dir = tempfile::tempdir().unwrap();
                let path = written(dir.path(), &text.replace("\"furnished\"", "\"primitive\""));
                let spec = read_uncounted(&path, Some(scale), dir.path()).unwrap();
                let spec = checked(spec, &path).unwrap();
                let kinds: Vec<&str> = spec.stages.iter().map(|s| s.task.kind()).collect();
                assert!(kinds.contains(&"evaluate"), "{path:?}");
                assert_eq!(kinds.last(), Some(&"report"), "{path:?}");
            }
            files += 1;
        }
        assert!(files >= 8);
    }

    #[test]
    fn an_unknown_field_is_named_with_its_line() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(JobKind::Primitive).replace("bins = 637", "binns = 637");
        let error = read(&written(dir.path(), &text), dir.path()).unwrap_err();
        assert_eq!(error.code, Code::Input);
        assert!(
            error.message.contains("binns") && error.message.contains("job.toml"),
            "{}",
            error.message
        );
    }

    #[test]
    fn a_negative_gate_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let text =
            template(JobKind::Primitive).replace("gate_start_m = 1.0", "gate_start_m = -1.0");
        let error = read(&written(dir.path(), &text), dir.path()).unwrap_err();
        assert!(
            error.message.contains("render.gate_start_m"),
            "{}",
            error.message
        );
    }

    #[test]
    fn subsets_and_strategies_can_be_switched_on_in_the_template() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(JobKind::Primitive)
            .replace("spots = 25 ", "spots = 100 ")
            .replace("# subsets", "subsets")
            .replace("# per_spot", "per_spot")
            .replace("# strategy", "strategy");
        let spec = read(&written(dir.path(), &text), dir.path()).unwrap();
        let render = &spec.stages[0].task.as_render().unwrap().render;
        assert_eq!(render.subsets, [4, 25]);
        assert!(render.per_spot);
        assert_eq!(render.strategy.len(), 2);
        let wrong = text.replace("image_lobes", "lobes");
        let error = read(&written(dir.path(), &wrong), dir.path()).unwrap_err();
        assert!(
            error.message.contains("render.strategy: \"lobes\"")
                && error.message.contains("image_lobes"),
            "{}",
            error.message
        );
    }

    #[test]
    fn an_error_may_be_asked_for_instead_of_paths() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(JobKind::Primitive).replace("samples = 32", "error = \"10%\"");
        let spec = read(&written(dir.path(), &text), dir.path()).unwrap();
        let budget = picofarm_proto::model::Budget::Error(0.1);
        let render = &spec.stages[0].task.as_render().unwrap().render;
        assert_eq!(render.budget, budget);
    }

    #[test]
    fn a_missing_scene_file_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let error = read(&written(dir.path(), &template(JobKind::Files)), dir.path()).unwrap_err();
        assert!(
            error.message.contains("scenes.files[0]"),
            "{}",
            error.message
        );
        assert_eq!(error.code, Code::Input);
    }

    mod hostile {
        use proptest::prelude::*;

        use super::*;

        /// How many cases; `PICOFARM_FUZZ=n` runs n times as many.
        fn cases() -> u32 {
            let times = std::env::var("PICOFARM_FUZZ").map_or(1, |n| n.parse().expect("a number"));
            300 * times
        }

        fn kind() -> impl Strategy<Value = JobKind> {
            prop_oneof![
                Just(JobKind::Furnished),
                Just(JobKind::Primitive),
                Just(JobKind::Files),
                Just(JobKind::Graph),
                Just(JobKind::Train),
                Just(JobKind::Sweep)
            ]
        }

        /// A value where a field's was, or text where any was.
        fn spoilt() -> impl Strategy<Value = String> {
            let value = prop_oneof![
                Just("-1".to_owned()),
                Just("1e400".to_owned()),
                Just("nan".to_owned()),
                Just("9223372036854775807".to_owned()),
                Just("[[]]".to_owned()),
                Just("{ a = { b = [1, {}] } }".to_owned()),
                Just("\"../../../etc\"".to_owned()),
                any::<f64>().prop_map(|x| format!("{x:?}")),
                any::<String>().prop_map(|text| format!("{text:?}")),
            ];
            let line =
                (kind(), any::<prop::sample::Index>(), value).prop_map(|(kind, at, value)| {
                    let text = template(kind);
                    let mut lines: Vec<_> = text.lines().map(str::to_owned).collect();
                    let at = at.index(lines.len());
                    if let Some((name, _)) = lines[at].clone().split_once('=') {
                        lines[at] = format!("{name}= {value}");
                    }
                    lines.join("\n")
                });
            let bytes = (
                kind(),
                prop::collection::vec((any::<prop::sample::Index>(), any::<char>()), 1..6),
            )
                .prop_map(|(kind, changes)| {
                    let mut text: Vec<char> = template(kind).chars().collect();
                    for (at, char) in changes {
                        let at = at.index(text.len());
                        text[at] = char;
                    }
                    text.into_iter().collect()
                });
            prop_oneof![3 => line, 2 => bytes, 1 => any::<String>()]
        }

        proptest! {
            #![proptest_config(ProptestConfig { cases: cases(), ..ProptestConfig::default() })]

            #[test]
            fn any_text_is_a_job_or_an_error_that_names_the_file(text in spoilt()) {
                let dir = tempfile::tempdir().unwrap();
                match read(&written(dir.path(), &text), dir.path()) {
                    Ok(spec) => {
                        spec.check().unwrap();
                        spec.check_places().unwrap();
                    }
                    Err(error) => prop_assert!(error.message.contains("job.toml"), "{}", error.message),
                }
            }
        }
    }

    #[test]
    fn a_store_beside_the_job_file_is_resolved_and_a_url_that_climbs_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let at = |store: &str| {
            let text = template(JobKind::Primitive).replace("\"picofarm-data/store\"", store);
            read(&written(dir.path(), &text), dir.path())
        };
        let spec = at("\"../store\"").unwrap();
        let above = spec.stages[0].task.writes().unwrap().0;
        let parent = dir
            .path()
            .canonicalize()
            .unwrap()
            .parent()
            .unwrap()
            .join("store");
        assert_eq!(Path::new(above), parent);
        let error = at("\"file:///data/../etc\"").unwrap_err();
        assert!(error.message.contains("output.store"), "{}", error.message);
    }
}
