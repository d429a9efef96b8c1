//! Reads job files and resolves the inputs that a submission must pin: furniture, hashes of scene
//! files, renderer version, absolute store.

use std::path::Path;

use picofarm_proto::{
    show,
    spec::{JobSpec, RenderTask, TaskSpec, scaled},
};
use picofarm_tasks::Submission;

use crate::{
    error::{CliError, Result},
    files,
};

/// Reads a job file and pins everything that a submission needs, except the number of scenes of
/// existing data sets.
#[cfg(test)]
fn read(path: &Path, asset_dir: &Path) -> Result<JobSpec> {
    checked(read_uncounted(path, None, asset_dir)?, path)
}

fn checked(spec: JobSpec, path: &Path) -> Result<JobSpec> {
    spec.check_submitted()
        .map_err(|e| CliError::input(format!("{}: {e}", path.display())))?;
    Ok(spec)
}

fn read_uncounted(path: &Path, scale: Option<&str>, asset_dir: &Path) -> Result<JobSpec> {
    let stdin = path == Path::new("-");
    let text = match stdin {
        true => files::read_stdin(files::LISTS)?,
        false => files::read_text(path, files::LISTS)?,
    };
    let failed = |e: &dyn std::fmt::Display| {
        let what = show::suggest(e.to_string().trim_end());
        CliError::input(format!("{}: {what}", path.display()))
            .hint("`picofarm job init` writes a job file with every field explained")
    };
    // No TOML starts with a brace.
    let json = text.trim_start().starts_with('{');
    let value: serde_json::Value = match json {
        true => serde_json::from_str(&text).map_err(|e| failed(&e))?,
        false => {
            let table: toml::Table = toml::from_str(&text).map_err(|e| failed(&e))?;
            serde_json::to_value(&table).map_err(|e| failed(&e))?
        }
    };
    // TOML is parsed from the text if possible, because errors then name the line.
    let spec: JobSpec = if json || scale.is_some() || value.get("scale").is_some() {
        let value = scaled(value, scale).map_err(|e| failed(&e))?;
        serde_json::from_value(value).map_err(|e| failed(&e))?
    } else {
        toml::from_str(&text).map_err(|e| failed(&e))?
    };
    let base = path
        .parent()
        .filter(|p| !stdin && !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    resolve(spec, base, asset_dir).map_err(|e| CliError {
        message: format!("{}: {}", path.display(), e.message),
        ..e
    })
}

/// Reads a job file and pins everything that a submission needs. If the file omits the number of
/// scenes of an existing data set, it is read from the store. `scale` selects one of the file's
/// sizes. The file is TOML or JSON; `-` is standard input, whose paths start at the current folder.
///
/// # Errors
/// Input errors that name the file, the field and the expected value. Also fails if a data set
/// cannot be opened.
pub async fn read_counted(path: &Path, scale: Option<&str>, asset_dir: &Path) -> Result<JobSpec> {
    let mut spec = read_uncounted(path, scale, asset_dir)?;
    for i in 0..spec.stages.len() {
        let (before, rest) = spec.stages.split_at_mut(i);
        let stage = &mut rest[0];
        if let Some((source, count)) = stage.task.reads_mut()
            && *count == 0
        {
            // A data set that the job makes has the scenes of its source, counted before.
            let place = (&source.store, &source.dataset);
            if let Some(maker) = before.iter().find(|s| s.task.writes() == Some(place)) {
                *count = maker.tasks();
                continue;
            }
            let failed = |e: picofarm_store::StorageError| {
                CliError::input(format!(
                    "{}: stage {:?}: source: {e}",
                    path.display(),
                    stage.name
                ))
                .hint("give the number of its scenes as `count`, or make the data set first")
            };
            let (store, prefix) = picofarm_store::open_store(&source.store).map_err(failed)?;
            let dataset = picofarm_dataset::Dataset::open(store, prefix.join(&*source.dataset));
            *count = dataset.await.map_err(failed)?.spec().scenes;
        }
    }
    checked(spec, path)
}

/// Pins furniture, file contents, versions and absolute locations.
///
/// # Errors
/// Fails if a field is out of range, a store location is invalid, a file is missing, or furniture
/// is not installed.
fn resolve(mut spec: JobSpec, base: &Path, asset_dir: &Path) -> Result<JobSpec> {
    let several = spec.stages.len() > 1;
    for stage in &mut spec.stages {
        resolve_task(&mut stage.task, base, asset_dir).map_err(|e| match several {
            true => CliError {
                message: format!("stage {:?}: {}", stage.name, e.message),
                ..e
            },
            false => e,
        })?;
    }
    // Stages that read an import learn its number of scenes only now.
    spec.resolve()?;
    Ok(spec)
}

/// Like `resolve`, for the tasks of one stage.
///
/// # Errors
/// As [`read_counted`].
pub fn resolve_task(task: &mut TaskSpec, base: &Path, asset_dir: &Path) -> Result<()> {
    let here = Submission {
        base,
        assets: &[asset_dir.to_owned()],
    };
    Ok(picofarm_tasks::resolve(task, &here)?)
}

/// Like `resolve_task`, for one rendering.
///
/// # Errors
/// As [`read_counted`].
pub fn resolve_render(task: RenderTask, base: &Path, asset_dir: &Path) -> Result<RenderTask> {
    let mut spec = TaskSpec::Render(task);
    resolve_task(&mut spec, base, asset_dir)?;
    match spec {
        TaskSpec::Render(task) => Ok(task),
        _ => unreachable!("a rendering stays one"),
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::{args::JobKind, commands::job::template::template, error::Code};

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
            JobKind::Desktop,
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
    fn a_job_in_json_is_the_same_job_as_in_toml() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(JobKind::Primitive);
        let expected = read(&written(dir.path(), &text), dir.path()).unwrap();
        let table: toml::Table = toml::from_str(&text).unwrap();
        let json = serde_json::to_string_pretty(&table).unwrap();
        let found = read(&written(dir.path(), &json), dir.path()).unwrap();
        assert_eq!(found, expected);
        let wrong = json.replace("\"resolution\"", "\"resolutions\"");
        let error = read(&written(dir.path(), &wrong), dir.path()).unwrap_err();
        assert!(
            error.message.contains("did you mean `resolution`"),
            "{error:?}"
        );
    }

    #[test]
    fn every_experiment_is_a_job_at_each_of_its_sizes() {
        let folder =
            Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap()).join("../deploy/experiments");
        let mut files = 0;
        for file in std::fs::read_dir(&folder).unwrap() {
            let path = file.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            let sizes: Vec<&str> = text
                .lines()
                .filter_map(|line| line.strip_prefix("[scale.")?.split(']').next())
                .collect();
            assert!(sizes.len() >= 2, "{path:?}");
            for scale in sizes {
                // Furnished rooms need assets. The test uses primitive rooms; nothing else changes.
                let dir = tempfile::tempdir().unwrap();
                let text = text.replace("\"furnished\"", "\"primitive\"");
                let job = written(dir.path(), &text.replace("../../picofarm-data", "data"));
                if path.ends_with("laboratory.toml") {
                    // The captures that it imports are made first: their folder is empty here.
                    for noise in ["noisy", "clean", "four", "one"] {
                        let captures = dir.path().join(format!("data/laboratory/{scale}/{noise}"));
                        std::fs::create_dir_all(captures).unwrap();
                    }
                    let error = read_uncounted(&job, Some(scale), dir.path()).unwrap_err();
                    assert!(error.message.contains("spot_1.mat"), "{}", error.message);
                    continue;
                }
                let spec = read_uncounted(&job, Some(scale), dir.path()).unwrap();
                let spec = checked(spec, &job).unwrap();
                let kinds: Vec<&str> = spec.stages.iter().map(|s| s.task.kind()).collect();
                // The errors of a reconstruction are stored with it, and `dataset info` shows their
                // means.
                if !kinds.contains(&"reconstruct") {
                    assert!(kinds.contains(&"evaluate"), "{path:?}");
                    assert_eq!(kinds.last(), Some(&"report"), "{path:?}");
                }
            }
            files += 1;
        }
        assert!(files >= 8);
    }

    #[test]
    fn no_experiment_of_the_paper_learns_from_mirrored_scenes() {
        let folder =
            Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap()).join("../deploy/experiments");
        let mut networks = 0;
        for file in std::fs::read_dir(&folder).unwrap() {
            let path = file.unwrap().path();
            // Sweep and runtimes are no experiments of the paper, and the laboratory has no
            // networks.
            let others = ["sweep.toml", "runtimes.toml", "laboratory.toml"];
            if others.iter().any(|other| path.ends_with(other)) {
                continue;
            }
            for scale in ["mini", "paper"] {
                let text = std::fs::read_to_string(&path).unwrap();
                let dir = tempfile::tempdir().unwrap();
                let job = written(dir.path(), &text.replace("\"furnished\"", "\"primitive\""));
                let spec = read_uncounted(&job, Some(scale), dir.path()).unwrap();
                for stage in &spec.stages {
                    // Networks on evidence are not of the paper.
                    if let TaskSpec::Train(task) = &stage.task
                        && !task.train.takes_evidence()
                    {
                        assert!(!task.train.augment, "{path:?}, {}", stage.name);
                        networks += 1;
                    }
                }
            }
        }
        assert!(networks > 40, "{networks}");
    }

    #[test]
    fn experiments_keep_their_models_where_the_readme_looks_for_them() {
        let here = std::env::var("CARGO_MANIFEST_DIR").unwrap();
        let root = Path::new(&here).parent().unwrap();
        let root = root.canonicalize().unwrap();
        let readme = std::fs::read_to_string(root.join("README.md")).unwrap();
        assert!(
            readme.contains("picofarm job submit deploy/experiments/intensity.toml --scale mini")
        );
        assert!(readme.contains("picofarm model list picofarm-data/experiments"));
        let file = root.join("deploy/experiments/intensity.toml");
        let spec = read_uncounted(&file, Some("mini"), &root).unwrap();
        let trains = spec.stages.iter().find_map(|s| s.task.trains()).unwrap();
        assert_eq!(Path::new(trains.0), root.join("picofarm-data/experiments"));
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
    fn what_the_desktop_template_leaves_out_is_what_it_says() {
        let dir = tempfile::tempdir().unwrap();
        let left_out = template(JobKind::Desktop);
        let rooms = left_out.find("# [scenes.rooms]").unwrap();
        let end = left_out.find("\n[render]").unwrap();
        let said = left_out[rooms..end]
            .replace("# [", "[")
            .replace("\n# ", "\n");
        let said = format!("{}{said}{}", &left_out[..rooms], &left_out[end..]);
        let read = |text: &str| read(&written(dir.path(), text), dir.path()).unwrap();
        assert_eq!(read(&said), read(&left_out));
        let wider = said.replace("scale = [0.22, 0.34]", "scale = [0.22, 0.4]");
        assert_ne!(read(&wider), read(&left_out));
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
    fn every_render_setting_of_the_template_can_be_switched_on() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(JobKind::Primitive).replace("spots = 25 ", "spots = 100 ");
        let (scenes, rest) = text.split_once("[render]").expect("it renders");
        let (render, rest) = rest.split_once("[output]").expect("it has an output");
        let render = render.replace("\n# ", "\n");
        let text = format!("{scenes}[render]{render}[output]{rest}");
        let several = text.replace("[905]", "[905, 532]");
        let refused = read(&written(dir.path(), &several), dir.path()).unwrap_err();
        let message = &refused.message;
        assert!(message.contains("render.wavelengths_nm"), "{message}");
        assert!(message.contains("has 2, expected one"), "{message}");
        let spec = read(&written(dir.path(), &text), dir.path()).unwrap();
        let TaskSpec::Render(RenderTask { render, .. }) = &spec.stages[0].task else {
            unreachable!("the template renders");
        };
        assert_eq!(render.subsets, [4, 25]);
        assert!(render.per_spot);
        assert_eq!(render.strategy.path_reuse, Some(1));
        assert!(render.strategy.mirror_images.is_some());
        let beam = render.optics.beam.expect("it has a width");
        assert_eq!((beam.diameter_mm, beam.divergence_mrad), (4.0, 1.0));
        let all = serde_json::to_value(render).unwrap();
        let (_, settings) = text.split_once("[render]").expect("it renders");
        let lines = settings.lines().skip(1);
        for (name, _) in lines.map_while(|line| line.split_once(" =")) {
            assert!(!all[name].is_null(), "{name} is unread or its default");
        }
        let wrong = text.replace("diameter_mm = 4", "diameter_mm = -4");
        let message = read(&written(dir.path(), &wrong), dir.path())
            .unwrap_err()
            .message;
        assert!(message.contains("render.beam.diameter_mm"), "{message}");
        let wrong = text.replace("mirror_images", "lobes");
        let error = read(&written(dir.path(), &wrong), dir.path()).unwrap_err();
        assert!(
            error.message.contains("render.strategy: \"lobes\"")
                && error.message.contains("mirror_images"),
            "{}",
            error.message
        );
    }

    #[test]
    fn an_error_may_be_asked_for_instead_of_paths() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(JobKind::Primitive).replace("samples = 32", "error = \"10%\"");
        let spec = read(&written(dir.path(), &text), dir.path()).unwrap();
        let budget = picofarm_settings::Budget::Error(0.1);
        let TaskSpec::Render(RenderTask { render, .. }) = &spec.stages[0].task else {
            unreachable!("the template renders");
        };
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

        /// Number of cases; `PICOFARM_FUZZ=n` runs n times as many.
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

        /// Replaces a field's value, or any piece of text.
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
