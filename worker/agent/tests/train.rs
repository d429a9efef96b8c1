//! Training and evaluating as tasks: published once, gone on with after a stop or a loss, and what is refused. The data
//! are made up: nothing is rendered.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use picofarm_agent::{
    Control, Executor, Output, Task, TaskError, TaskExecutor, model_version, split::Splitter,
};
use picofarm_dataset::*;
use picofarm_proto::{
    ids::JobId,
    key::{TaskKey, stage_key},
    model::{
        EvaluateSettings, EvaluateTask, SourceSettings, StageSpec, TaskSpec, TrainSettings,
        TrainTask,
    },
    split::{Parts, SplitSettings},
};
use serde_json::json;
use tempfile::TempDir;
use tokio::runtime::Handle;
use uuid::Uuid;

const SIDE: u32 = 8;
const BINS: u32 = 8;
const SCENES: u64 = 8;

/// A store with a small data set, split.
struct Place {
    dir: TempDir,
}

impl Place {
    async fn new() -> Self {
        let place = Self {
            dir: tempfile::tempdir().unwrap(),
        };
        for scene in 0..SCENES {
            place.publish(scene).await;
        }
        place.split("default", Parts::Counts([5, 2, 1])).await;
        place
    }

    fn store(&self) -> String {
        self.dir.path().to_str().unwrap().to_owned()
    }

    async fn publish(&self, scene: u64) {
        let spec = DatasetSpec {
            scenes: SCENES,
            height: SIDE,
            width: SIDE,
            spots: 2,
            subsets: Subsets::NONE,
            per_spot: true,
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 1.5,
                bins: BINS,
            },
            profile: Profile::LOSSLESS,
        };
        let pixels = (SIDE * SIDE) as usize;
        let depth: Vec<f32> = (0..pixels)
            .map(|p| 1.0 + ((p as u64 * 7 + scene * 3) % 5) as f32 * 0.5)
            .collect();
        // The nearer, the earlier.
        let light = |spot: usize| -> Vec<f32> {
            let mut h = vec![0.01; pixels * BINS as usize];
            for (p, z) in depth.iter().enumerate() {
                h[p * BINS as usize + (*z * 2.0) as usize] = (1 + spot) as f32 / z;
            }
            h
        };
        let each = [light(0), light(1)];
        let transient: Vec<f32> = each[0].iter().zip(&each[1]).map(|(a, b)| a + b).collect();
        let spots: Vec<_> = (0..2)
            .map(|s| {
                Some(Spot {
                    position: [s as f32 - 0.5, 0.0, 3.0],
                    normal: [0.0, 0.0, -1.0],
                    path_m: (0.25f32 + 9.0).sqrt(),
                })
            })
            .collect();
        let record = SceneRecord {
            transient: &transient,
            subsets: &[SubsetRecord {
                quantity: Quantity::TransientSpots,
                planes: each.iter().map(Vec::as_slice).collect(),
            }],
            depth: &depth,
            range: &depth,
            normal: &vec![0.5; pixels * 3],
            instance: &vec![1; pixels],
            label: &vec![1; pixels],
            specular: &(0..pixels)
                .map(|p| u8::from(p % 5 == 0))
                .collect::<Vec<_>>(),
            visibility: &(0..pixels * 2)
                .map(|i| u8::from(i % 3 > 0))
                .collect::<Vec<_>>(),
            rgb: &vec![0.25; pixels * 3],
            spots: &spots,
            intrinsics: Intrinsics {
                fx: 4.0,
                fy: 4.0,
                cx: 4.0,
                cy: 4.0,
            },
            camera: [[1.0; 4]; 4],
            laser: [0.0; 3],
            scale: 400.0,
        };
        let provenance = Provenance {
            task_key: TaskKey([scene as u8 + 1; 32]).to_string(),
            renderer: "transient-1".into(),
            seed: 7,
            plan: json!({}),
        };
        let (store, prefix) = open_store(&self.store()).unwrap();
        let dataset = Dataset::create_or_open(store, prefix.join("rooms"), &spec)
            .await
            .unwrap();
        dataset.publish(scene, &record, &provenance).await.unwrap();
    }

    async fn split(&self, name: &str, parts: Parts) {
        let (store, name) = (self.store(), name.to_owned());
        let splitter = Splitter::new(Handle::current());
        let run = move || {
            let settings = SplitSettings {
                name,
                seed: 3,
                parts,
            };
            splitter.run(&settings, &store, "rooms", &Control::default())
        };
        tokio::task::spawn_blocking(run).await.unwrap().unwrap();
    }

    fn models(&self) -> Models {
        let (store, prefix) = open_store(&self.store()).unwrap();
        Models::new(store, &prefix)
    }

    fn source(&self) -> SourceSettings {
        SourceSettings {
            store: self.store(),
            dataset: "rooms".into(),
        }
    }

    fn training(&self, more: serde_json::Value) -> StageSpec {
        let mut settings = json!({
            "task": "tof", "model": "m", "version": model_version(), "seed": 5,
            "net": {"width": 2, "levels": 2}, "optimise": {"epochs": 40, "batch": 2},
            // A checkpoint each 600 ms.
            "checkpoint_minutes": 0.01,
        });
        for (name, value) in more.as_object().unwrap() {
            settings[name] = value.clone();
        }
        let train: TrainSettings = serde_json::from_value(settings).unwrap();
        StageSpec::new(TaskSpec::Train(TrainTask {
            source: self.source(),
            count: SCENES,
            train,
        }))
    }

    fn evaluation(&self, more: serde_json::Value) -> StageSpec {
        let mut settings = json!({"models": ["m"], "version": model_version()});
        for (name, value) in more.as_object().unwrap() {
            settings[name] = value.clone();
        }
        let evaluate: EvaluateSettings = serde_json::from_value(settings).unwrap();
        StageSpec::new(TaskSpec::Evaluate(EvaluateTask {
            source: self.source(),
            count: SCENES,
            evaluate,
        }))
    }

    fn files(&self, folder: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let root = self.dir.path().join(folder);
        let (mut found, mut folders) = (BTreeMap::new(), vec![root.clone()]);
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).into_iter().flatten() {
                let path = entry.unwrap().path();
                match path.is_dir() {
                    true => folders.push(path),
                    false => {
                        let bytes = std::fs::read(&path).unwrap();
                        found.insert(path.strip_prefix(&root).unwrap().to_path_buf(), bytes);
                    }
                }
            }
        }
        found
    }
}

/// Runs a stage's only task on a worker of its own.
async fn run_with(stage: StageSpec, control: Arc<Control>) -> Result<Output, TaskError> {
    let task = Task {
        job: JobId::from_uuid(Uuid::nil()),
        stage: stage_key(&stage),
        spec: Arc::new(stage),
        index: 0,
    };
    let runtime = Handle::current();
    let work = move || {
        let executor = TaskExecutor::new(&[], runtime);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(2)
            .build()
            .unwrap();
        pool.install(|| executor.run(&task, &control))
    };
    tokio::task::spawn_blocking(work).await.unwrap()
}

async fn run(stage: StageSpec) -> Result<Output, TaskError> {
    run_with(stage, Arc::default()).await
}

async fn refused(stage: StageSpec) -> String {
    match run(stage).await {
        Err(TaskError::User(text)) => text,
        other => panic!("expected a user's error, found {other:?}"),
    }
}

/// Runs it, and stops it when it has said that it is past `share`; `false` if it was done before that.
async fn run_until(stage: StageSpec, share: f32) -> bool {
    let control = Arc::new(Control::default());
    let (watched, stage) = (control.clone(), tokio::spawn(run_with(stage, control)));
    while !stage.is_finished() && watched.fraction() < share {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    watched.stop();
    match stage.await.unwrap() {
        Ok(_) => false,
        Err(TaskError::Stopped) => true,
        Err(other) => panic!("{other}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_model_is_trained_once_and_says_where_it_comes_from() {
    let place = Place::new().await;
    let control = Arc::new(Control::default());
    let output = run_with(place.training(json!({})), control.clone())
        .await
        .unwrap();
    assert!(!output.adopted);
    let (fraction, at) = control.progress();
    assert_eq!(fraction, 1.0);
    assert!(
        at.text.starts_with("epoch 40/40, loss ") && at.text.ends_with(" samples/s"),
        "{at:?}"
    );
    assert!(
        at.figures["loss"].is_finite() && at.figures["steps"] > 0.0,
        "{at:?}"
    );
    assert!(at.figures["validation_loss"] > 0.0, "{at:?}");
    let models = place.models();
    let manifest = models.manifest("m").await.unwrap();
    assert_eq!(manifest.sha256(), output.manifest_sha256);
    assert_eq!(manifest.total_bytes(), output.bytes);
    let from = &manifest.lineage;
    assert_eq!(
        (&*from.dataset, from.seed, &*from.code),
        ("rooms", 5, &*model_version())
    );
    assert_eq!((from.training_scenes, from.validation_scenes), (5, 2));
    assert_eq!((&*from.split.name, from.split.version), ("default", 1));
    assert_eq!(models.checkpoints("m").await.unwrap(), []);
    let before = place.files("models");
    let again = run(place.training(json!({"checkpoint_minutes": 5.0})))
        .await
        .unwrap();
    assert!(again.adopted);
    assert_eq!(again.manifest_sha256, output.manifest_sha256);
    let mut forced = place.training(json!({}));
    forced.force = true;
    assert!(!run(forced).await.unwrap().adopted);
    assert_eq!(place.files("models"), before);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_training_that_is_stopped_again_and_again_ends_as_one_that_never_was() {
    let calm = Place::new().await;
    run(calm.training(json!({}))).await.unwrap();
    let place = Place::new().await;
    let mut stops = 0;
    for share in [0.01, 0.2, 0.3, 0.5, 0.7, 0.9] {
        if !run_until(place.training(json!({})), share).await {
            break;
        }
        stops += 1;
        assert!(!place.models().checkpoints("m").await.unwrap().is_empty());
        if stops % 2 == 0 {
            // The newest checkpoint is torn: the one before is used.
            let checkpoints = place.files("models/m/checkpoints");
            let (newest, bytes) = checkpoints.last_key_value().unwrap();
            let path = place.dir.path().join("models/m/checkpoints").join(newest);
            std::fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
        }
    }
    assert!(stops > 0, "no training was stopped half-way");
    run(place.training(json!({}))).await.unwrap();
    assert_eq!(place.files("models"), calm.files("models"));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_trained_of_other_settings_under_the_name_is_in_nobodys_way() {
    let place = Place::new().await;
    assert!(run_until(place.training(json!({"seed": 6})), 0.01).await);
    run(place.training(json!({}))).await.unwrap();
    let calm = Place::new().await;
    run(calm.training(json!({}))).await.unwrap();
    let manifest = Path::new("m/manifest.json");
    assert_eq!(
        place.files("models")[manifest],
        calm.files("models")[manifest]
    );
    let said = refused(place.training(json!({"seed": 6}))).await;
    assert!(said.contains("choose another name"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn models_build_on_models_of_the_store() {
    let place = Place::new().await;
    run(place.training(json!({}))).await.unwrap();
    let mirrors = json!({"task": "specular", "model": "s", "specular": {"on": "m"}});
    run(place.training(mirrors)).await.unwrap();
    let models = place.models();
    let (tof, mirrors) = (
        models.manifest("m").await.unwrap(),
        models.manifest("s").await.unwrap(),
    );
    assert_eq!(mirrors.lineage.models["m"], tof.sha256());
    let shadows = json!({"task": "shadow", "model": "sh", "shadow": {"tof": "m"}, "histogram": "transient_spots", "spots": [1]});
    run(place.training(shadows)).await.unwrap();
    run(place.evaluation(json!({"models": ["s", "sh"]})))
        .await
        .unwrap();
    let found = models.evaluations("sh").await.unwrap();
    assert_eq!(found[0].histogram, "transient_spots");
    assert!(
        found[0].metrics["iou"].is_number()
            && found[0].metrics["baselines"]["all"]["iou"].is_number()
    );
    let more = json!({"model": "n", "from": "m", "scenes": 2});
    run(place.training(more)).await.unwrap();
    assert_eq!(
        models.manifest("n").await.unwrap().lineage.training_scenes,
        2
    );
    for (more, part) in [
        (
            json!({"task": "shadow", "model": "x", "shadow": {"tof": "s"}}),
            "train.shadow.tof: \"s\" predicts \"specular\"",
        ),
        (
            json!({"task": "specular", "model": "x", "specular": {"on": "m"}, "net": {"width": 4, "levels": 2}}),
            "train.net.width: is 4, but 2",
        ),
        (
            json!({"task": "shadow", "model": "x", "from": "m"}),
            "train.from: \"m\" predicts \"tof\"",
        ),
        (
            json!({"model": "x", "from": "nobody"}),
            "holds no \"nobody\"; there are: m, n, s, sh",
        ),
    ] {
        let said = refused(place.training(more)).await;
        assert!(said.contains(part), "{said}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_trained_is_refused_by_name() {
    let place = Place::new().await;
    place.split("lone", Parts::Counts([8, 0, 0])).await;
    for (more, part) in [
        (json!({"split": "nobody"}), "train.split"),
        (json!({"scenes": 6}), "train.scenes: 6 scenes"),
        (json!({"histogram": "transient_25"}), "train.histogram"),
        (
            json!({"histogram": "transient_spots", "spots": [2]}),
            "train.spots: 2",
        ),
        (json!({"version": "other"}), "train.version"),
        (json!({"input": {"bins": 9}}), "train.input.bins: 9 is more"),
        (
            json!({"net": {"width": 2, "levels": 5}}),
            "train.net.levels",
        ),
        (json!({"optimise": {"batch": 9}}), "optimise.batch"),
        (
            json!({"optimise": {"precision": "bf16"}}),
            "train.optimise.precision",
        ),
        (
            json!({"split": "lone", "optimise": {"early_stop": 3}}),
            "train.optimise.early_stop",
        ),
    ] {
        let said = refused(place.training(more)).await;
        assert!(said.contains(part), "{said}");
    }
    std::fs::remove_file(place.dir.path().join("rooms/manifests/3.json")).unwrap();
    let said = refused(place.training(json!({"split": "lone"}))).await;
    assert!(
        said.contains("source") && said.contains("scene 3"),
        "{said}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluation_is_kept_beside_each_model_and_made_once() {
    let place = Place::new().await;
    run(place.training(json!({}))).await.unwrap();
    let first = run(place.evaluation(json!({}))).await.unwrap();
    assert!(!first.adopted);
    let found = place.models().evaluations("m").await.unwrap();
    let [evaluation] = &found[..] else {
        panic!("{found:?}")
    };
    assert_eq!((&*evaluation.side, evaluation.scenes), ("test", 1));
    assert_eq!(evaluation.histogram, "transient");
    let figures = &evaluation.metrics;
    assert!(
        figures["mae_m"].is_number() && figures["baselines"]["constant"]["mae_m"].is_number(),
        "{figures}"
    );
    let again = run(place.evaluation(json!({}))).await.unwrap();
    assert_eq!(
        (again.adopted, again.manifest_sha256),
        (true, first.manifest_sha256)
    );
    run(place.evaluation(json!({"side": "train", "scenes": 3})))
        .await
        .unwrap();
    assert_eq!(place.models().evaluations("m").await.unwrap().len(), 2);
    for (more, part) in [
        (json!({"models": ["m", "nobody"]}), "evaluate.models[1]"),
        (json!({"scenes": 9}), "evaluate.scenes"),
        (json!({"histogram": "transient_4"}), "evaluate.histogram"),
    ] {
        let said = refused(place.evaluation(more)).await;
        assert!(said.contains(part), "{said}");
    }
}
