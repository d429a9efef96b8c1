//! Job files: the commented template, reading, and resolving what a submission must pin (furniture,
//! scene files' content, renderer version, absolute store).

use std::path::{Component, Path, PathBuf};

use picofarm_proto::model::{JobSpec, SceneKind};

use crate::{
    args::SceneKindArg,
    assets,
    error::{CliError, Code, Result, io},
};

/// A job file to start from.
pub fn template(kind: SceneKindArg) -> String {
    let scenes = match kind {
        SceneKindArg::Furnished => {
            "kind = \"furnished\"        # furnished rooms; also: primitive, files\n\
             count = 8\n\
             seed = 1                  # scene i derives its own seed from (seed, i)\n\
             spots = 25                # laser spots: 1, 4, 16, 25 or 100\n\
             fov_deg = 90.0            # horizontal field of view\n\
             assets = \"auto\"           # sweethome3d where installed, else parametric\n\
             min_specular = 1          # mirrors a room at least\n"
        }
        SceneKindArg::Primitive => {
            "kind = \"primitive\"        # a cube, a cylinder and a mirror in a room\n\
             count = 8\n\
             seed = 1                  # scene i derives its own seed from (seed, i)\n\
             spots = 25                # laser spots: 1, 4, 16, 25 or 100\n\
             fov_deg = 90.0            # horizontal field of view; jittered by scene\n"
        }
        SceneKindArg::Files => {
            "kind = \"files\"            # .glb, .gltf or .json scenes, one a task\n\
             files = [\"scene.glb\"]     # relative to this file\n\
             spots = 25                # for files that bring no laser\n"
        }
    };
    format!(
        "# A picofarm job. `picofarm job plan FILE` says what it would run; `picofarm job submit FILE` runs it.\n\
         name = \"rooms\"\n\n\
         [scenes]\n{scenes}\n\
         [render]\n\
         resolution = 256          # pixels, square\n\
         gate_start_m = 1.0        # start of the time gate, metres of optical path\n\
         bin_width_m = 0.0384      # metres of optical path (128 ps)\n\
         bins = 637\n\
         samples = 32              # camera paths per pixel; or: error = \"10%\"\n\
         max_bounces = 0           # 0 = until the gate ends\n\
         # subsets = [4, 25]       # with spots = 100: histograms of these subsets too, from the same rays\n\
         # per_spot = true         # histograms of each spot alone, from the same rays: spots times the size\n\
         # strategy = {{ share = 1, image_lobes = false }}  # ways of finding light, chosen by hand\n\n\
         [output]\n\
         store = \"picofarm-data/store\"   # a folder that every worker can reach, or s3://bucket/prefix\n\
         dataset = \"rooms\"\n\
         profile = \"sqrt-u16\"            # or: plain-f32\n\n\
         [limits]\n\
         max_failures = 3          # a task's own failures before it is given up\n\
         max_crashes = 3           # losses of the worker under it before it is given up\n"
    )
}

/// Reads a job file and pins everything a submission needs.
///
/// # Errors
/// Input errors that name the file, the field and what was expected.
pub fn read(path: &Path, asset_dir: &Path) -> Result<JobSpec> {
    let text = std::fs::read_to_string(path).map_err(|e| io(path.display(), &e))?;
    let spec: JobSpec = toml::from_str(&text).map_err(|e| {
        CliError::input(format!("{}: {}", path.display(), e.to_string().trim_end()))
            .hint("`picofarm job init` writes a job file with every field explained")
    })?;
    let base = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    resolve(spec, base, asset_dir).map_err(|e| CliError {
        message: format!("{}: {}", path.display(), e.message),
        ..e
    })
}

/// Pins furniture, file contents, the renderer's version and the store's absolute place.
///
/// # Errors
/// A field out of its limits, a store that cannot be one, a missing file, or furniture that is not installed.
pub fn resolve(mut spec: JobSpec, base: &Path, asset_dir: &Path) -> Result<JobSpec> {
    let renderer = picofarm_agent::renderer_version();
    if spec.render.renderer.is_empty() {
        spec.render.renderer = renderer;
    } else if spec.render.renderer != renderer {
        return Err(CliError::input(format!(
            "render.renderer: this program renders {renderer:?}, the job asks for {:?}",
            spec.render.renderer
        ))
        .hint("leave the field out, or use the picofarm version that made the data set"));
    }
    spec.check()?;
    picofarm_agent::strategy(&spec.render.strategy)
        .map_err(|e| CliError::input(format!("render.strategy: {e}")))?;
    picofarm_dataset::Profile::parse(&spec.output.profile)
        .map_err(|e| CliError::input(format!("output.profile: {e}")))?;
    if !spec.output.store.contains("://") {
        spec.output.store = absolute(base, &spec.output.store)?.display().to_string();
    }
    picofarm_dataset::check_location(&spec.output.store)
        .map_err(|e| CliError::input(format!("output.store: {e}")))?;
    match &mut spec.scenes.kind {
        SceneKind::Furnished { assets: name, .. } => *name = assets::resolve(name, asset_dir)?,
        SceneKind::Primitive => {}
        SceneKind::Files { files } => {
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
    spec.check_places()?;
    Ok(spec)
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
            SceneKindArg::Furnished,
            SceneKindArg::Primitive,
            SceneKindArg::Files,
        ] {
            let path = written(dir.path(), &template(kind));
            let spec = read(&path, dir.path()).unwrap();
            assert!(Path::new(&spec.output.store).is_absolute());
        }
    }

    #[test]
    fn an_unknown_field_is_named_with_its_line() {
        let dir = tempfile::tempdir().unwrap();
        let text = template(SceneKindArg::Primitive).replace("bins = 637", "binns = 637");
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
            template(SceneKindArg::Primitive).replace("gate_start_m = 1.0", "gate_start_m = -1.0");
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
        let text = template(SceneKindArg::Primitive)
            .replace("spots = 25 ", "spots = 100 ")
            .replace("# subsets", "subsets")
            .replace("# per_spot", "per_spot")
            .replace("# strategy", "strategy");
        let spec = read(&written(dir.path(), &text), dir.path()).unwrap();
        assert_eq!(spec.render.subsets, [4, 25]);
        assert!(spec.render.per_spot);
        assert_eq!(spec.render.strategy.len(), 2);
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
        let text = template(SceneKindArg::Primitive).replace("samples = 32", "error = \"10%\"");
        let spec = read(&written(dir.path(), &text), dir.path()).unwrap();
        let budget = picofarm_proto::model::Budget::Error(0.1);
        assert_eq!(spec.render.budget, budget);
    }

    #[test]
    fn a_missing_scene_file_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let error = read(
            &written(dir.path(), &template(SceneKindArg::Files)),
            dir.path(),
        )
        .unwrap_err();
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

        fn kind() -> impl Strategy<Value = SceneKindArg> {
            prop_oneof![
                Just(SceneKindArg::Furnished),
                Just(SceneKindArg::Primitive),
                Just(SceneKindArg::Files)
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
            let text = template(SceneKindArg::Primitive).replace("\"picofarm-data/store\"", store);
            read(&written(dir.path(), &text), dir.path())
        };
        let above = at("\"../store\"").unwrap().output.store;
        let parent = dir
            .path()
            .canonicalize()
            .unwrap()
            .parent()
            .unwrap()
            .join("store");
        assert_eq!(Path::new(&above), parent);
        let error = at("\"file:///data/../etc\"").unwrap_err();
        assert!(error.message.contains("output.store"), "{}", error.message);
    }
}
