//! Tests that every kind of task must pass. The suite takes the list of kinds from the executor,
//! and fails if one of them is missing from the jobs below.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use picofarm_files::Opener;
use picofarm_proto::{
    ids::JobId,
    key::stage_key,
    spec::{
        JobSpec, StageSpec,
        memory::{Known, Shape, peak_bytes},
    },
};
use picofarm_scene::{
    Material, export,
    plato::{self, PlatoObject, PlatoSettings},
};
use picofarm_tasks::{
    Control, Executor, Output, StorePrefixes, Submission, Task, TaskError, TaskExecutor, resolve,
};
use serde_json::{Value, json};
use tokio::runtime::{Handle, Runtime};
use uuid::Uuid;

const SCENES: u64 = 4;

/// A job with every kind except imports. Its last stage writes the scenes that the import test
/// reads.
fn first_job(store: &str) -> Value {
    let scenes = json!({"kind": "primitive", "count": SCENES, "seed": 5, "spots": 4});
    let render = json!({"resolution": 16, "samples": 2});
    let network = json!({"width": 2, "levels": 2});
    json!({"name": "kinds", "stage": [
        {"name": "rooms", "scenes": scenes, "render": render, "output": {"store": store, "dataset": "rooms"}},
        {"name": "joined", "scenes": scenes, "render": render, "parts": 2,
         "output": {"store": store, "dataset": "joined"}},
        {"kind": "generate", "scenes": scenes, "generate": {"dest": format!("{store}/files")}},
        {"kind": "reprocess", "source": "rooms", "reprocess": {"sensor": {"dark_per_bin": 0.1}},
         "output": {"store": store, "dataset": "dark", "profile": "counts-u16"}},
        {"kind": "split", "source": "rooms", "split": {"counts": [2, 1, 1]}},
        {"kind": "verify", "source": "rooms"},
        {"kind": "train", "source": "rooms", "needs": ["split"], "train": {"target": "tof", "model": "m",
         "input": {"bins": 8}, "net": network, "optimise": {"epochs": 2, "batch": 2}}},
        {"kind": "evaluate", "source": "rooms", "evaluate": {"models": ["train"], "shards": 2}},
        {"kind": "promote", "source": "rooms", "promote": {"model": "best", "among": ["train"]}},
        {"kind": "infer", "source": "rooms", "infer": {"models": ["train"]},
         "output": {"store": store, "dataset": "seen"}},
        {"kind": "demultiplex", "source": "rooms", "output": {"store": store, "dataset": "apart"}},
        {"kind": "reconstruct", "source": "rooms", "reconstruct": {"views": 2, "grid": {"nodes": 32, "iterations": 3}},
         "output": {"store": store, "dataset": "rooms-3d"}},
        networks(store, 8),
        {"name": "capture", "scenes": {"kind": "primitive", "count": 1, "seed": 5, "spots": 4},
         "render": {"resolution": 16, "samples": 2, "per_spot": true}, "output": {"store": store, "dataset": "capture"}},
        {"kind": "calibrate", "source": "capture", "calibrate": {"accept_unexplained": true},
         "output": {"store": store, "dataset": "calibrated"}},
        {"kind": "report", "report": {"name": "all", "models": ["train"], "pictures": 1}},
        {"kind": "export", "source": "rooms", "export": {"dest": format!("{store}/release"), "format": "sb3d"}},
    ]})
}

/// A stage that fits small PlatoNeRF networks to each room.
fn networks(store: &str, steps: u32) -> Value {
    json!({"name": "networks", "kind": "reconstruct", "source": "rooms",
        "reconstruct": {"field": "mlp", "grid": {"nodes": 24}, "mlp": {"steps": steps, "width": 8, "batch": 16}},
        "output": {"store": store, "dataset": "rooms-mlp"}})
}

fn import_job(store: &str) -> Value {
    json!({"name": "import", "stage": [
        {"kind": "import", "import": {"folder": format!("{store}/release")},
         "output": {"store": store, "dataset": "back"}},
    ]})
}

/// A store and an executor.
struct Place {
    dir: tempfile::TempDir,
    runtime: Runtime,
}

impl Place {
    fn new() -> Self {
        Self {
            dir: tempfile::tempdir().unwrap(),
            runtime: Runtime::new().unwrap(),
        }
    }

    fn store(&self) -> String {
        self.dir.path().display().to_string()
    }

    /// Returns the stages of a job as submitted.
    fn stages(&self, job: Value) -> Vec<StageSpec> {
        let mut spec: JobSpec = serde_json::from_value(job).unwrap();
        let here = Submission {
            base: self.dir.path(),
            assets: &[],
        };
        for stage in &mut spec.stages {
            resolve(&mut stage.task, &here).unwrap();
        }
        spec.resolve().unwrap();
        spec.check().unwrap();
        spec.check_places().unwrap();
        for stage in &spec.stages {
            stage.check_resolved().unwrap();
        }
        spec.stages
    }

    fn executor(&self) -> TaskExecutor {
        let runtime: Handle = self.runtime.handle().clone();
        TaskExecutor::new(&[], runtime, Opener::anywhere())
    }

    /// Runs one task on a worker with `threads` threads.
    fn run(
        &self,
        stage: &StageSpec,
        index: u64,
        (threads, control): (usize, &Control),
    ) -> Result<Output, TaskError> {
        let leased = stage.only(index, index + 1);
        let task = Task {
            job: JobId::from_uuid(Uuid::nil()),
            stage: stage_key(stage),
            spec: Arc::new(leased),
            index,
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().unwrap();
        pool.install(|| self.executor().run(&task, control))
    }

    /// Runs all tasks of a stage and returns the SHA-256 of each result.
    fn run_all(&self, stage: &StageSpec, threads: usize) -> Vec<String> {
        let ran = (0..stage.tasks()).map(|index| {
            let output = self.run(stage, index, (threads, &Control::default()));
            let output = output.unwrap_or_else(|e| panic!("{} {index}: {e}", stage.name));
            output.manifest_sha256
        });
        ran.collect()
    }

    /// Returns all files of the store except the training speeds, which are not results.
    fn files(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let (mut found, mut folders) = (BTreeMap::new(), vec![self.dir.path().to_owned()]);
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else if !path.ends_with("speed.json") {
                    let bytes = fs::read(&path).unwrap();
                    let name = path.strip_prefix(self.dir.path()).unwrap();
                    found.insert(name.to_owned(), bytes);
                }
            }
        }
        found
    }
}

fn assert_same(ours: &BTreeMap<PathBuf, Vec<u8>>, theirs: &BTreeMap<PathBuf, Vec<u8>>, what: &str) {
    let names = |files: &BTreeMap<PathBuf, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(ours), names(theirs), "{what}");
    for (name, bytes) in ours {
        assert!(theirs[name] == *bytes, "{what}: {}", name.display());
    }
}

/// Runs every stage of both jobs in turn. Calls `each` before and after each stage.
fn every_kind(
    place: &Place,
    mut before: impl FnMut(&StageSpec),
    mut after: impl FnMut(&StageSpec, Vec<String>),
) {
    let mut seen = BTreeSet::new();
    for job in [first_job, import_job] {
        for stage in place.stages(job(&place.store())) {
            before(&stage);
            let results = place.run_all(&stage, 2);
            after(&stage, results);
            seen.insert(stage.task.kind().to_owned());
            seen.insert(stage.task.ability().into_owned());
        }
    }
    let kinds: BTreeSet<String> = place.executor().kinds().into_keys().collect();
    assert_eq!(seen, kinds, "the suite has a stage of every kind");
}

#[test]
fn a_task_run_again_by_force_or_on_another_number_of_threads_gives_the_same_bytes() {
    let place = Place::new();
    every_kind(
        &place,
        |_| {},
        |stage, results| {
            let (name, files) = (&stage.name, place.files());
            assert_eq!(place.run_all(stage, 1), results, "{name}");
            assert_same(&place.files(), &files, name);
            let forced = StageSpec {
                force: true,
                ..stage.clone()
            };
            assert_eq!(place.run_all(&forced, 3), results, "{name}, forced");
            assert_same(&place.files(), &files, name);
        },
    );
}

#[test]
fn a_task_that_is_stopped_first_leaves_what_a_calm_one_does() {
    let (calm, struck) = (Place::new(), Place::new());
    let mut expected = Vec::new();
    every_kind(&calm, |_| {}, |_, results| expected.push(results));
    let mut expected = expected.into_iter();
    every_kind(
        &struck,
        |stage| {
            let control = Control::default();
            control.stop();
            match struck.run(stage, 0, (2, &control)) {
                Ok(_) | Err(TaskError::Stopped) => {}
                Err(other) => panic!("{}: {other}", stage.name),
            }
        },
        |stage, results| {
            // A report contains the training speed of its models, which varies.
            let expected = expected.next().unwrap();
            if stage.task.kind() != "report" {
                assert_eq!(results, expected, "{}", stage.name);
            }
        },
    );
}

#[test]
fn another_version_is_refused_with_its_field_and_both_versions() {
    let place = Place::new();
    every_kind(
        &place,
        |stage| {
            let mut other = stage.clone();
            let Some(version) = other.task.version_mut() else {
                return;
            };
            *version = "another-1".into();
            let field = stage.task.versioned().0;
            match place.run(&other, 0, (1, &Control::default())) {
                Err(TaskError::User(text)) => assert!(
                    text.contains(field)
                        && text.contains("another-1")
                        && text.contains(stage.task.version()),
                    "{text}"
                ),
                found => panic!("{}: {found:?}", stage.name),
            }
            let mut empty = stage.clone();
            empty.task.version_mut().unwrap().clear();
            let error = empty.check_resolved().unwrap_err();
            assert_eq!(error.field, field);
        },
        |_, _| {},
    );
}

#[test]
fn a_task_is_allowed_in_its_store_and_refused_outside_of_it() {
    let place = Place::new();
    let inside = StorePrefixes::new(&[place.store()]).unwrap();
    let outside = StorePrefixes::new(&["/elsewhere".to_owned()]).unwrap();
    every_kind(
        &place,
        |stage| {
            for index in 0..stage.tasks() {
                let leased = stage.only(index, index + 1);
                inside.check(&leased, index).unwrap();
                let why = outside.check(&leased, index).unwrap_err();
                assert!(why.contains("store prefixes"), "{}: {why}", stage.name);
            }
            let results = stage.task.results();
            assert!(Path::new(results.store).starts_with(place.dir.path()));
        },
        |_, _| {},
    );
}

#[test]
fn a_job_survives_the_catalog_and_says_its_memory() {
    let place = Place::new();
    every_kind(
        &place,
        |stage| {
            let text = serde_json::to_string(stage).unwrap();
            let back: StageSpec = serde_json::from_str(&text).unwrap();
            assert_eq!(&back, stage);
            assert_eq!(stage_key(&back), stage_key(stage));
            let shape = Shape {
                height: 16,
                width: 16,
                bins: 637,
                spots: 4,
            };
            let known = Known {
                source: Some(shape),
                networks: stage.task.network(&shape).into_iter().collect(),
            };
            // A report's memory depends only on its models.
            if stage.task.kind() != "report" {
                let bytes = peak_bytes(&stage.task, &known, 2).unwrap();
                assert!(
                    (50 << 20..2 << 30).contains(&bytes),
                    "{}: {bytes}",
                    stage.name
                );
            }
        },
        |_, _| {},
    );
}

#[test]
fn damaged_histograms_are_the_stores_trouble_and_name_the_object() {
    let place = Place::new();
    let stages = place.stages(first_job(&place.store()));
    for stage in &stages {
        if matches!(stage.task.kind(), "render" | "part" | "split" | "train") {
            place.run_all(stage, 2);
        }
    }
    for scene in 0..SCENES {
        let object = place
            .dir
            .path()
            .join(format!("rooms/transient/c/{scene}/0/0/0"));
        let mut bytes = fs::read(&object).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x55;
        fs::write(&object, bytes).unwrap();
    }
    let mut tried = BTreeSet::new();
    for stage in &stages {
        let kind = stage.task.kind();
        // Kinds that read no histogram, such as a reconstruction from ground truth. A calibration
        // here reads another data set.
        let other = ["split", "promote", "reconstruct", "calibrate"];
        if stage.task.reads().is_none() || other.contains(&kind) {
            continue;
        }
        let fresh = StageSpec {
            force: true,
            ..stage.clone()
        };
        match place.run(&fresh, 0, (2, &Control::default())) {
            Err(TaskError::Damaged(text)) => {
                assert!(text.contains("rooms/transient/c/"), "{kind}: {text}");
            }
            // Verification fails because it has found the damage.
            Err(TaskError::User(text)) if kind == "verify" => {
                assert!(text.contains("rooms/transient/c/"), "{text}");
            }
            found => panic!("{kind}: {found:?}"),
        }
        tried.insert(kind);
    }
    assert!(tried.len() >= 5, "{tried:?}");
}

/// PlatoNeRF's room with four beams, and mirrors for some of its walls.
fn room_of_mirrors() -> Vec<u8> {
    let settings = PlatoSettings {
        object: PlatoObject::Empty,
        spots: 4,
        resolution: 24,
    };
    let mut scene = plato::generate(&settings).unwrap();
    for wall in &mut scene.objects[3..5] {
        let mut mesh = (*wall.mesh).clone();
        mesh.materials[0] = Material::mirror("mirror", 0.01);
        wall.mesh = mesh.into();
    }
    export::glb_bytes(&scene).unwrap()
}

#[test]
fn a_beam_that_a_mirror_folds_is_left_out_of_captures_and_named() {
    let place = Place::new();
    fs::write(place.dir.path().join("room.glb"), room_of_mirrors()).unwrap();
    let store = place.store();
    let job = json!({"name": "mirrors", "stage": [
        {"name": "rooms", "scenes": {"kind": "files", "files": ["room.glb"], "spots": 4},
         "render": {"resolution": 24, "samples": 2, "bins": 391, "bin_width_m": 0.0384, "per_spot": true},
         "output": {"store": store, "dataset": "rooms"}},
        {"kind": "reconstruct", "source": "rooms",
         "reconstruct": {"from": "captures", "views": 0, "grid": {"nodes": 32, "iterations": 3}},
         "output": {"store": store, "dataset": "rooms-3d"}},
    ]});
    for stage in place.stages(job) {
        place.run_all(&stage, 2);
    }
    let metrics = place.dir.path().join("rooms-3d/scenes/0/metrics.json");
    let metrics: Value = serde_json::from_slice(&fs::read(metrics).unwrap()).unwrap();
    let left_out = metrics["left_out"].as_array().unwrap();
    assert!((1..4).contains(&left_out.len()), "{metrics}");
    assert_eq!(metrics["spots"], 4 - left_out.len(), "{metrics}");
    for left in left_out {
        let why = left["why"].as_str().unwrap();
        assert!(why.contains("a mirror folds the beam"), "{why}");
    }
}

#[test]
fn networks_that_are_stopped_go_on_from_their_checkpoint_to_the_same_bytes() {
    let (calm, struck) = (Place::new(), Place::new());
    let stages = |place: &Place| {
        let store = place.store();
        let first = first_job(&store)["stage"][0].clone();
        let job = json!({"name": "networks", "stage": [first, networks(&store, 60)]});
        let stages = place.stages(job);
        place.run_all(&stages[0], 2);
        stages
    };
    let (of_calm, of_struck) = (stages(&calm), stages(&struck));
    calm.run_all(&of_calm[1], 2);

    let newest = || {
        let files = struck.files().into_keys();
        let steps = files.filter_map(|f| {
            let name = f.file_name()?.to_str()?.strip_suffix(".ckpt")?;
            name.parse::<u64>().ok()
        });
        steps.max()
    };
    let mut steps = vec![0];
    for strike in 0..20u8 {
        let control = Arc::new(Control::default());
        let hand = Arc::clone(&control);
        // The networks train between progress 0.49 and 0.85.
        let at = 0.5 + 0.3 * f32::from(strike) / 20.0;
        let striker = std::thread::spawn(move || {
            while hand.fraction() < at {
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            hand.stop();
        });
        let found = struck.run(&of_struck[1], 0, (1 + usize::from(strike) % 3, &control));
        assert!(matches!(found, Err(TaskError::Stopped)), "{found:?}");
        striker.join().unwrap();
        steps.extend(newest());
    }
    assert!(steps.is_sorted() && steps.last() > Some(&30), "{steps:?}");
    steps.dedup();
    assert!(steps.len() > 10, "{steps:?}");

    // A damaged checkpoint costs only itself.
    let newest = struck
        .files()
        .into_keys()
        .filter(|f| f.extension().is_some_and(|e| e == "ckpt"))
        .max();
    let newest = struck.dir.path().join(newest.unwrap());
    let mut bytes = fs::read(&newest).unwrap();
    bytes[100] ^= 1;
    fs::write(&newest, bytes).unwrap();
    struck.run_all(&of_struck[1], 2);
    // The files are the same: no checkpoint is left.
    assert_same(&struck.files(), &calm.files(), "after 20 strikes");
}
