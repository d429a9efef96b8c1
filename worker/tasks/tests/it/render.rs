//! The render executor on tiny scenes: what it publishes, when it adopts, and how it classifies
//! errors.

use crate::common;

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use common::{FakeFarm, soon, spec, stage};
use picofarm_dataset::{Dataset, Wavelength};
use picofarm_files::Opener;
use picofarm_proto::{
    ids::JobId,
    key::stage_key,
    spec::{FileView, RenderTask, SceneFile, SceneKind},
};
use picofarm_scene::{export, primitive};
use picofarm_settings::Spots;
use picofarm_store::published::Manifest as _;
use picofarm_store::{VerifyMode, identify_store, open_store};
use picofarm_tasks::{Control, Executor, Output, Task, TaskError, TaskExecutor};
use sha2::{Digest, Sha256};
use tempfile::TempDir;
use tokio::runtime::Handle;
use uuid::Uuid;

/// A store in a folder of its own, and a job that writes there.
struct Place {
    dir: TempDir,
    spec: RenderTask,
}

impl Place {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let spec = spec(dir.path().join("store").to_str().unwrap());
        Self { dir, spec }
    }

    fn dataset(&self) -> PathBuf {
        self.dir.path().join("store/tiny")
    }

    fn manifest(&self, scene: u64) -> Vec<u8> {
        fs::read(self.dataset().join(format!("manifests/{scene}.json"))).unwrap()
    }

    /// Runs one task on a pool of `threads`, as the worker would.
    async fn run_on(&self, threads: usize, index: u64) -> Result<Output, TaskError> {
        self.run_with(threads, index, Arc::new(Control::default()))
            .await
    }

    async fn run(&self, index: u64) -> Result<Output, TaskError> {
        self.run_on(1, index).await
    }

    async fn run_with(
        &self,
        threads: usize,
        index: u64,
        control: Arc<Control>,
    ) -> Result<Output, TaskError> {
        let task = Task {
            job: JobId::from_uuid(Uuid::nil()),
            stage: stage_key(&stage(self.spec.clone())),
            spec: Arc::new(stage(self.spec.clone())),
            index,
        };
        let runtime = Handle::current();
        let work = tokio::task::spawn_blocking(move || {
            let executor = TaskExecutor::new(&[], runtime, Opener::anywhere());
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.unwrap().install(|| executor.run(&task, &control))
        });
        soon("a tiny render", work).await.unwrap()
    }

    /// Returns the message of a failure caused by the job itself.
    async fn complaint(&self, index: u64) -> String {
        match self.run(index).await {
            Err(TaskError::User(text)) => text,
            other => panic!("expected a failure of the job's own, got {other:?}"),
        }
    }
}

fn sha256(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// Returns the contents of every file under `dir`, by relative path.
fn files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![dir.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let bytes = fs::read(&path).unwrap();
                found.insert(path.strip_prefix(dir).unwrap().to_path_buf(), bytes);
            }
        }
    }
    found
}

#[tokio::test]
async fn a_published_scene_reads_back_and_the_output_names_its_manifest() {
    let place = Place::new();
    let output = place.run(3).await.unwrap();
    assert!(!output.adopted);
    assert_eq!(output.manifest_sha256, sha256(&place.manifest(3)));

    let (store, prefix) = open_store(&place.spec.output.store).unwrap();
    let dataset = Dataset::open(store, prefix.join("tiny")).await.unwrap();
    assert_eq!(dataset.spec().scenes, 100);
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    let manifest = dataset.manifest(3).await.unwrap();
    assert_eq!(manifest.total_bytes(), output.bytes);
    let plan = &manifest.provenance.plan;
    assert_eq!(plan["scene"]["source"], primitive::GENERATOR_VERSION);
    assert!(plan["strategies"].as_array().is_some_and(|s| !s.is_empty()));

    let transient = dataset.read_transient(3).await.unwrap();
    assert_eq!(transient.len(), 16 * 16 * 40);
    assert!(transient.iter().any(|h| *h > 0.0));
    // The spot is in front of the camera and inside the image, because positions are in the
    // camera's frame.
    let spots = dataset.read_spots(3).await.unwrap();
    let [x, y, z] = spots[0].expect("the beam meets a wall").position;
    let i = dataset.read_intrinsics(3).await.unwrap();
    let (u, v) = (i.fx * x / z + i.cx, i.fy * y / z + i.cy);
    assert!(
        z > 0.0 && (u - 8.0).abs() < 0.5 && (v - 8.0).abs() < 0.5,
        "{u} {v} {z}"
    );
}

#[tokio::test]
async fn a_second_run_adopts_what_the_first_published() {
    let place = Place::new();
    let first = place.run(0).await.unwrap();
    let before = files(&place.dataset());
    let second = place.run(0).await.unwrap();
    assert!(second.adopted);
    assert_eq!(
        (second.manifest_sha256, second.bytes),
        (first.manifest_sha256, first.bytes)
    );
    assert_eq!(files(&place.dataset()), before);
}

#[tokio::test]
async fn one_and_two_threads_publish_the_same_bytes() {
    let (mut one, mut two) = (Place::new(), Place::new());
    for place in [&mut one, &mut two] {
        place.spec.render.max_bounces = 3;
    }
    one.run_on(1, 0).await.unwrap();
    two.run_on(2, 0).await.unwrap();
    assert_eq!(files(&one.dataset()), files(&two.dataset()));
}

#[tokio::test]
async fn a_furnished_room_is_generated_with_the_furniture_that_the_job_names() {
    let mut place = Place::new();
    place.spec.scenes.kind = SceneKind::Furnished {
        assets: "parametric-1".into(),
        min_specular: 1,
        floor_plan: picofarm_settings::FloorPlan::Box,
    };
    let output = place.run(0).await.unwrap();
    assert!(!output.adopted && output.bytes > 0);
}

#[tokio::test]
async fn furniture_that_is_not_here_fails_the_task_and_says_how_to_get_it() {
    let mut place = Place::new();
    place.spec.scenes.kind = SceneKind::Furnished {
        assets: "sweethome3d-0000".into(),
        min_specular: 1,
        floor_plan: picofarm_settings::FloorPlan::Box,
    };
    let text = place.complaint(0).await;
    assert!(
        text.contains("sweethome3d-0000") && text.contains("picofarm assets install"),
        "{text}"
    );
}

/// Creates a job of one scene file with `content`, written as `name`.
fn of_file(name: &str, content: &[u8]) -> Place {
    let mut place = Place::new();
    let path = place.dir.path().join(name);
    fs::write(&path, content).unwrap();
    place.spec.scenes.kind = SceneKind::Files {
        files: vec![SceneFile {
            path: path.to_str().unwrap().into(),
            sha256: sha256(content),
        }],
        first: 0,
        root: None,
        view: FileView::default(),
    };
    place.spec.scenes.count = 1;
    place
}

fn primitive_glb(spots: u32) -> Vec<u8> {
    let settings = primitive::PrimitiveSettings {
        spots: Spots::Grid(spots),
        width: 32,
        height: 32,
        ..Default::default()
    };
    export::glb_bytes(&primitive::generate(1, &settings).unwrap()).unwrap()
}

#[tokio::test]
async fn a_scene_file_is_rendered_at_the_jobs_resolution_with_its_own_laser() {
    let mut place = of_file("room.glb", &primitive_glb(4));
    place.spec.scenes.spots = Spots::Grid(4);
    place.run(0).await.unwrap();
    let (store, prefix) = open_store(&place.spec.output.store).unwrap();
    let dataset = Dataset::open(store, prefix.join("tiny")).await.unwrap();
    assert_eq!(dataset.read_intrinsics(0).await.unwrap().cx, 8.0);
    assert_eq!(dataset.read_spots(0).await.unwrap().len(), 4);
}

#[tokio::test]
async fn a_scene_file_without_a_laser_gets_the_jobs_grid() {
    let mut place = of_file("wall.gltf", include_bytes!("common/wall.gltf"));
    place.spec.scenes.spots = Spots::Grid(4);
    place.run(0).await.unwrap();
}

#[tokio::test]
async fn a_laser_that_differs_from_the_jobs_spots_fails_the_task() {
    let place = of_file("room.glb", &primitive_glb(4));
    let text = place.complaint(0).await;
    assert!(
        text.contains("4 beams") && text.contains("scenes.spots = 1"),
        "{text}"
    );
}

#[tokio::test]
async fn a_changed_scene_file_fails_the_task_with_both_hashes() {
    let place = of_file("room.glb", &primitive_glb(1));
    let path = place.dir.path().join("room.glb");
    fs::write(&path, b"something else").unwrap();
    let text = place.complaint(0).await;
    assert!(text.contains(&sha256(b"something else")), "{text}");
    assert!(
        text.contains(&sha256(&primitive_glb(1))) && text.contains("picofarm job retry"),
        "{text}"
    );
    assert!(text.starts_with("scenes.files[0]: "), "{text}");
}

#[tokio::test]
async fn a_missing_or_broken_scene_file_fails_the_task_and_is_named() {
    let place = of_file("room.glb", b"glTF but no more");
    let broken = place.complaint(0).await;
    assert!(broken.contains("room.glb"), "{broken}");
    fs::remove_file(place.dir.path().join("room.glb")).unwrap();
    let missing = place.complaint(0).await;
    assert!(
        missing.contains("room.glb") && missing.contains("every worker must see it"),
        "{missing}"
    );
}

#[tokio::test]
async fn another_renderer_or_profile_fails_the_task() {
    let mut place = Place::new();
    place.spec.output.profile = "gzip".into();
    assert!(
        place
            .complaint(0)
            .await
            .starts_with("output.profile: \"gzip\"")
    );
    place.spec.render.renderer = "transient-0".into();
    assert!(place.complaint(0).await.starts_with("render.renderer: "));
}

#[tokio::test]
async fn a_store_that_cannot_be_written_is_an_interruption() {
    let mut place = Place::new();
    let file = place.dir.path().join("file");
    fs::write(&file, b"").unwrap();
    place.spec.output.store = file.join("store").to_str().unwrap().into();
    match place.run(0).await {
        Err(TaskError::Store(text)) => assert!(text.contains("store"), "{text}"),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_worker_whose_store_is_not_the_jobs_renders_nothing_and_leaves_nothing() {
    let place = Place::new();
    let store = place.dir.path().join("store");
    let location = place.spec.output.store.clone();
    let (opened, prefix) = open_store(&location).unwrap();
    let identity = identify_store(&*opened, &prefix).await.unwrap();
    let control = || {
        let stores = BTreeMap::from([(location.clone(), identity.to_string())]);
        Arc::new(Control::expecting(&stores))
    };
    // The machine that has the store.
    place.run_with(1, 0, control()).await.unwrap();
    let before = files(&store);

    // A machine where the store is not mounted: the folder is empty or missing.
    let mounted = place.dir.path().join("elsewhere");
    fs::rename(&store, &mounted).unwrap();
    for there in [true, false] {
        if there {
            fs::create_dir(&store).unwrap();
        }
        match place.run_with(1, 1, control()).await {
            Err(TaskError::Store(text)) => assert!(
                text.contains("has no store identity; expected") && text.contains("is it mounted?"),
                "{text}"
            ),
            other => panic!("{other:?}"),
        }
        assert_eq!(store.exists(), there, "the store's folder was made");
        if there {
            assert!(files(&store).is_empty());
            fs::remove_dir(&store).unwrap();
        }
    }

    // The store is mounted again. The identity is not part of the published files.
    fs::rename(&mounted, &store).unwrap();
    assert_eq!(files(&store), before);
    place.run_with(1, 1, control()).await.unwrap();
    let other = Place::new();
    other.run(1).await.unwrap();
    assert_eq!(other.manifest(1), place.manifest(1));
}

#[tokio::test]
async fn a_store_of_another_kind_or_a_data_set_of_another_gate_fails_the_task() {
    let mut place = Place::new();
    place.run(0).await.unwrap();
    place.spec.render.bins = 41;
    let gate = place.complaint(1).await;
    assert!(gate.contains("gate.bins"), "{gate}");
    place.spec.output.store = "ftp://host".into();
    assert!(place.complaint(1).await.contains("the scheme ftp"));
}

#[tokio::test]
async fn a_scene_of_another_job_in_the_same_place_fails_the_task_and_stays_as_it_is() {
    let mut place = Place::new();
    place.run(0).await.unwrap();
    let before = files(&place.dataset());
    place.spec.scenes.seed += 1;
    let text = place.complaint(0).await;
    assert!(
        text.contains("output.dataset") && text.contains("another job"),
        "{text}"
    );
    assert_eq!(files(&place.dataset()), before);
}

#[tokio::test]
async fn a_conflicting_object_is_an_alarm_that_names_it_and_nothing_is_overwritten() {
    let place = Place::new();
    place.run(0).await.unwrap();
    place.run(1).await.unwrap();
    let victim = place.dataset().join("depth/c/0/0/0");
    fs::remove_file(place.dataset().join("manifests/0.json")).unwrap();
    let other = fs::read(place.dataset().join("depth/c/1/0/0")).unwrap();
    fs::write(&victim, &other).unwrap();
    let text = place.complaint(0).await;
    assert!(
        text.contains("conflict") && text.contains("depth/c/0/0/0"),
        "{text}"
    );
    assert_eq!(fs::read(&victim).unwrap(), other);
    assert!(!place.dataset().join("manifests/0.json").exists());
}

#[tokio::test]
async fn a_published_scene_that_lost_an_object_is_rendered_again_and_repaired() {
    let place = Place::new();
    place.run(0).await.unwrap();
    let before = files(&place.dataset());
    fs::remove_file(place.dataset().join("depth/c/0/0/0")).unwrap();
    let output = place.run(0).await.unwrap();
    assert!(!output.adopted);
    assert_eq!(files(&place.dataset()), before);
}

#[tokio::test]
async fn a_rendered_scene_waits_for_its_store_and_is_published_once_it_can_be() {
    let place = Place::new();
    place.run(0).await.unwrap();
    // Scene 1's transient cannot be stored while a file occupies the path of its folder.
    let stone = place.dataset().join("transient/c/1");
    fs::write(&stone, b"").unwrap();
    let control = Arc::new(Control::default());
    let run = place.run_with(1, 1, control.clone());
    let clear = async {
        common::until("the render to end", || control.fraction() > 0.96).await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        fs::remove_file(&stone).unwrap();
    };
    let (output, ()) = tokio::join!(run, clear);
    assert_eq!(output.unwrap().manifest_sha256, sha256(&place.manifest(1)));

    // A worker stops waiting when it is asked to stop.
    fs::write(place.dataset().join("transient/c/2"), b"").unwrap();
    let control = Arc::new(Control::default());
    let stop = async {
        common::until("the render to end", || control.fraction() > 0.96).await;
        control.stop();
    };
    let (output, ()) = tokio::join!(place.run_with(1, 2, control.clone()), stop);
    assert_eq!(output, Err(TaskError::Stopped));
}

#[tokio::test]
async fn a_render_that_is_told_to_stop_stops_and_publishes_nothing() {
    let place = Place::new();
    let control = Arc::new(Control::default());
    control.stop();
    assert_eq!(place.run_with(1, 0, control).await, Err(TaskError::Stopped));
    assert!(!place.dataset().join("manifests").exists());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_whole_worker_renders_a_lease_and_its_successor_adopts_it() {
    let place = Place::new();
    for adopted in [false, true] {
        let mut farm = FakeFarm::start().await;
        let shutdown = tokio_util::sync::CancellationToken::new();
        let life = tokio::spawn(picofarm_tasks::run(
            common::config(farm.address),
            shutdown.clone(),
        ));
        let (mut c, hello) = farm.welcome(60_000).await;
        assert!(hello.assets.contains(&"parametric-1".into()));
        let mut lease = common::lease(1, 0, 2);
        lease.stage = stage(place.spec.clone());
        lease.key = stage_key(&lease.stage);
        c.grant(lease).await;
        let mut ended = Vec::new();
        for _ in 0..2 {
            let done = c.done().await;
            assert_eq!(done.adopted, adopted);
            assert_eq!(done.manifest_sha256, sha256(&place.manifest(done.index)));
            c.acknowledge(done.lease, done.index).await;
            ended.push(done.index);
        }
        // Small renders run side by side, and end in any order.
        ended.sort_unstable();
        assert_eq!(ended, [0, 1]);
        shutdown.cancel();
        let summary = soon("the end", life).await.unwrap().unwrap();
        assert_eq!(
            (summary.adopted, summary.computed),
            if adopted { (2, 0) } else { (0, 2) }
        );
    }
}

#[tokio::test]
async fn a_job_at_a_wavelength_stores_what_reflects_there() {
    let mut seen = vec![];
    for nm in [611.4, 464.3] {
        let mut place = Place::new();
        place.spec.render.optics.wavelengths_nm = Wavelength::of(&[nm]).unwrap();
        place.spec.output.profile = "lossless".into();
        place.run(1).await.unwrap();
        let (store, prefix) = open_store(&place.spec.output.store).unwrap();
        let dataset = Dataset::open(store, prefix.join("tiny")).await.unwrap();
        assert_eq!(dataset.spec().wavelengths_nm.nm(), Some(nm));
        let h = dataset.read_transient(1).await.unwrap();
        seen.push(h.iter().map(|&x| f64::from(x)).sum::<f64>());
    }
    // The walls have a colour of their own.
    assert!(
        seen.iter().all(|x| *x > 0.0) && seen[0] != seen[1],
        "{seen:?}"
    );
}
