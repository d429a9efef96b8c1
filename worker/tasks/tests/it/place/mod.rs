//! A store with a small synthetic data set for training, and a worker for one task.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::{collections::BTreeMap, path::PathBuf, sync::Arc, time::Duration};

use picofarm_dataset::*;
use picofarm_files::Opener;
use picofarm_proto::{
    ids::JobId,
    key::{TaskKey, stage_key},
    spec::{
        EvaluateSettings, EvaluateTask, InferTask, ReportTask, SourceSettings, StageSpec, TaskSpec,
        TrainSettings, TrainTask,
    },
    split::{Parts, SplitSettings},
};
use picofarm_results::*;
use picofarm_settings::Gpus;
use picofarm_store::*;
use picofarm_tasks::{
    Control, Executor, Output, Task, TaskError, TaskExecutor, infer_version, model_version,
    split::Splitter,
};
use serde_json::json;
use tempfile::TempDir;
use tokio::runtime::Handle;
use uuid::Uuid;

pub const SIDE: u32 = 8;
pub const BINS: u32 = 8;
pub const SCENES: u64 = 8;

/// Contents of files by path.
pub type Files = BTreeMap<PathBuf, Vec<u8>>;

/// A store with a small data set, split.
pub struct Place {
    pub dir: TempDir,
}

impl Place {
    pub async fn new() -> Self {
        let place = Self {
            dir: tempfile::tempdir().unwrap(),
        };
        for scene in 0..SCENES {
            place.publish("rooms", scene, [SIDE, BINS]).await;
        }
        place.split("default", Parts::Counts([5, 2, 1])).await;
        place
    }

    /// Creates a store in which three scenes lack the named quantities.
    pub async fn lacking(missing: &[&str]) -> Self {
        let place = Self {
            dir: tempfile::tempdir().unwrap(),
        };
        for scene in 0..SCENES {
            let lacks = if scene % 3 == 0 { missing } else { &[] };
            let size = [SIDE, BINS];
            place.publish_without("rooms", scene, size, lacks).await;
        }
        place.split("default", Parts::Counts([5, 2, 1])).await;
        place
    }

    pub fn store(&self) -> String {
        self.dir.path().to_str().unwrap().to_owned()
    }

    /// Publishes a scene. `size` = rows and columns of its images, and bins of its histograms (at
    /// least 8).
    pub async fn publish(&self, dataset: &str, scene: u64, size: [u32; 2]) {
        self.publish_without(dataset, scene, size, &[]).await;
    }

    /// Like `publish`, with a list of missing quantities in the manifest.
    pub async fn publish_without(
        &self,
        dataset: &str,
        scene: u64,
        [side, bins]: [u32; 2],
        missing: &[&str],
    ) {
        let spec = DatasetSpec {
            scenes: SCENES,
            height: side,
            width: side,
            spots: 2,
            subsets: Subsets::NONE,
            per_spot: true,
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 1.5,
                bins,
            },
            profile: Profile::LOSSLESS,
        };
        let pixels = (side * side) as usize;
        let depth: Vec<f32> = (0..pixels)
            .map(|p| 1.0 + ((p as u64 * 7 + scene * 3) % 5) as f32 * 0.5)
            .collect();
        // Nearer spots are seen earlier.
        let light = |spot: usize| -> Vec<f32> {
            let mut h = vec![0.01; pixels * bins as usize];
            for (p, z) in depth.iter().enumerate() {
                h[p * bins as usize + (*z * 2.0) as usize] = (1 + spot) as f32 / z;
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
            two_bounce: &[],
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
            plan: match missing {
                [] => json!({}),
                names => json!({"kind": "import", "missing": names}),
            },
        };
        let (store, prefix) = open_store(&self.store()).unwrap();
        let rooms = Dataset::create_or_open(store, prefix.join(dataset), &spec)
            .await
            .unwrap();
        rooms.publish(scene, &record, &provenance).await.unwrap();
    }

    pub async fn split(&self, name: &str, parts: Parts) {
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

    pub fn models(&self) -> Models {
        let (store, prefix) = open_store(&self.store()).unwrap();
        Models::new(store, &prefix)
    }

    pub fn source(&self) -> SourceSettings {
        SourceSettings {
            store: self.store(),
            dataset: "rooms".into(),
        }
    }

    pub fn training(&self, more: serde_json::Value) -> StageSpec {
        let mut settings = json!({
            "target": "tof", "model": "m", "version": model_version(), "seed": 5,
            "net": {"width": 2, "levels": 2}, "optimise": {"epochs": 40, "batch": 2},
            // A checkpoint every 600 ms.
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

    pub fn evaluation(&self, more: serde_json::Value) -> StageSpec {
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

    pub fn inference(&self, more: serde_json::Value) -> StageSpec {
        let mut settings = json!({"models": ["m", "sh", "s"], "version": infer_version()});
        for (name, value) in more.as_object().unwrap() {
            settings[name] = value.clone();
        }
        StageSpec::new(TaskSpec::Infer(InferTask {
            source: self.source(),
            count: SCENES,
            infer: serde_json::from_value(settings).unwrap(),
            output: serde_json::from_value(json!({"store": self.store(), "dataset": "seen"}))
                .unwrap(),
        }))
    }

    pub fn report(&self, more: serde_json::Value) -> StageSpec {
        let version = format!("{}/{}", model_version(), picofarm_report::VERSION);
        let mut settings =
            json!({"name": "main", "models": ["m"], "store": self.store(), "version": version});
        for (name, value) in more.as_object().unwrap() {
            settings[name] = value.clone();
        }
        let report = serde_json::from_value(settings).unwrap();
        StageSpec::new(TaskSpec::Report(ReportTask { report }))
    }

    /// Trains a network of each kind: `m`; `sh` on its depths in `depths`; `s` on its features.
    pub async fn train_all(&self) {
        let short = json!({"epochs": 10, "batch": 2});
        run(self.training(json!({"optimise": short})))
            .await
            .unwrap();
        self.predict("m", "depths").await;
        for settings in [
            json!({"target": "shadow", "model": "sh", "shadow": {"times": "depths"}, "optimise": short}),
            json!({"target": "specular", "model": "s", "specular": {"on": "m"}, "optimise": short}),
        ] {
            run(self.training(settings)).await.unwrap();
        }
    }

    /// Like `predict`, with a model trained for this purpose.
    pub async fn predict_with(&self, mut settings: serde_json::Value, folder: &str) {
        settings["optimise"] = json!({"epochs": 10, "batch": 2});
        let model = settings["model"].as_str().unwrap().to_owned();
        run(self.training(settings)).await.unwrap();
        self.predict(&model, folder).await;
    }

    /// Stores a model's predictions of every scene in a folder.
    pub async fn predict(&self, model: &str, folder: &str) {
        let mut stage = self.inference(json!({"models": [model]}));
        let TaskSpec::Infer(task) = &mut stage.task else {
            panic!("{stage:?}")
        };
        task.output.dataset = folder.into();
        for scene in 0..SCENES {
            run_at(stage.clone(), scene, Arc::default()).await.unwrap();
        }
    }

    /// Returns the contents of a folder of the store, except the training speeds.
    pub fn files(&self, folder: &str) -> Files {
        let root = self.dir.path().join(folder);
        let (mut found, mut folders) = (BTreeMap::new(), vec![root.clone()]);
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).into_iter().flatten() {
                let path = entry.unwrap().path();
                if path.ends_with("speed.json") {
                    continue;
                }
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

/// Asserts that both have the same files with equal contents, without printing their bytes.
pub fn assert_same(ours: &Files, theirs: &Files) {
    let names = |files: &Files| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(ours), names(theirs));
    for (name, bytes) in ours {
        let text =
            |bytes: &[u8]| String::from_utf8_lossy(&bytes[..bytes.len().min(4000)]).into_owned();
        assert!(
            theirs[name] == *bytes,
            "{}: {}\n{}",
            name.display(),
            text(bytes),
            text(&theirs[name])
        );
    }
}

/// Runs a stage's only task on a worker of its own.
pub async fn run_with(stage: StageSpec, control: Arc<Control>) -> Result<Output, TaskError> {
    run_at(stage, 0, control).await
}

/// Runs one of a stage's tasks on a worker of its own.
pub async fn run_at(
    stage: StageSpec,
    index: u64,
    control: Arc<Control>,
) -> Result<Output, TaskError> {
    run_on(Gpus::default(), stage, index, control).await
}

/// Like `run_at`, on a worker with GPUs.
pub async fn run_on(
    gpus: Gpus,
    stage: StageSpec,
    index: u64,
    control: Arc<Control>,
) -> Result<Output, TaskError> {
    let task = Task {
        job: JobId::from_uuid(Uuid::nil()),
        stage: stage_key(&stage),
        spec: Arc::new(stage),
        index,
    };
    let runtime = Handle::current();
    let work = move || {
        let executor = TaskExecutor::new(&[], runtime, Opener::anywhere());
        let executor = executor.with_gpus(&gpus).unwrap();
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(2)
            .build()
            .unwrap();
        pool.install(|| executor.run(&task, &control))
    };
    tokio::task::spawn_blocking(work).await.unwrap()
}

pub async fn run(stage: StageSpec) -> Result<Output, TaskError> {
    run_with(stage, Arc::default()).await
}

pub async fn refused(stage: StageSpec) -> String {
    match run(stage).await {
        Err(TaskError::User(text)) => text,
        other => panic!("expected a user's error, found {other:?}"),
    }
}

/// Runs the stage's task and stops it once its progress exceeds `share`. Returns `false` if it
/// finished first.
pub async fn run_until(stage: StageSpec, share: f32) -> bool {
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
