//! Tests of `kill -9` in the middle of any put, of publishers and repairers, one or two at a time:
//! no torn object is ever visible, the next run completes everything, and leftovers of the killed
//! processes are bounded and collected. `PICOFARM_KILLS=200` kills 200 times instead of 20.

use crate::common;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path as Folder, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::*;
use picofarm_dataset::*;
use picofarm_store::*;

/// The variable with the folder in which the killed process publishes its scenes.
const PLACE: &str = "PICOFARM_TEST_PUBLISH";
const SCENES: u64 = 4;
/// Number of concurrent puts of one process.
const PUTS: usize = 8;

type Objects = BTreeMap<String, Vec<u8>>;

/// Publishes every scene, and repairs broken ones.
async fn publish_all(folder: &Folder) {
    let spec = spec(Profile::default());
    let (store, prefix) = open_store(folder.to_str().unwrap()).unwrap();
    let dataset = Dataset::create_or_open(store, prefix, &spec).await.unwrap();
    for index in 0..SCENES {
        let scene = Scene::new(&spec, index);
        let encoded = dataset.encode(index, &scene.record(), &provenance());
        let encoded = encoded.unwrap();
        match dataset.publish_encoded(encoded.clone()).await {
            Ok(_) => {}
            Err(StorageError::Conflict { .. }) => {
                dataset.restore(encoded, None).await.unwrap();
            }
            Err(error) => panic!("{error}"),
        }
    }
}

/// This is also run in a separate process, which is killed; see [`PLACE`].
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn publishing_and_repairing_ends_with_every_scene() {
    if let Some(place) = std::env::var_os(PLACE) {
        let place = PathBuf::from(place);
        fs::write(place.with_extension(std::process::id().to_string()), b"").unwrap();
        publish_all(&place).await;
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    publish_all(folder.path()).await;
    let whole = objects(folder.path()).0;
    assert_eq!(
        whole.keys().filter(|k| k.starts_with("manifests/")).count() as u64,
        SCENES
    );
    let broken = folder.path().join("depth/c/1/0/0");
    fs::write(&broken, b"torn").unwrap();
    publish_all(folder.path()).await;
    assert_eq!(objects(folder.path()).0, whole);
}

/// Returns the visible objects and the unfinished files.
fn objects(folder: &Folder) -> (Objects, Vec<PathBuf>) {
    let (mut visible, mut unfinished) = (Objects::new(), Vec::new());
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).into_iter().flatten() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(folder).unwrap().display().to_string();
            if path.is_dir() {
                folders.push(path);
            } else if name.contains('#') {
                unfinished.push(path);
            } else {
                visible.insert(name, fs::read(&path).unwrap());
            }
        }
    }
    (visible, unfinished)
}

fn start(place: &Folder) -> Child {
    let name = "kills::publishing_and_repairing_ends_with_every_scene";
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", name]).env(PLACE, place);
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().unwrap()
}

/// Waits until the process is about to publish, then for `wait`, and kills it. Returns whether it
/// was still running.
fn kill_after(mut child: Child, place: &Folder, wait: Duration) -> bool {
    let ready = place.with_extension(child.id().to_string());
    let begun = Instant::now();
    while !ready.exists() {
        assert!(begun.elapsed() < Duration::from_secs(60), "it never began");
        std::thread::sleep(Duration::from_micros(200));
    }
    fs::remove_file(&ready).unwrap();
    std::thread::sleep(wait);
    let runs = child.try_wait().unwrap().is_none();
    let _ = child.kill();
    child.wait().unwrap();
    runs
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_in_the_middle_of_any_put_nothing_torn_is_visible_and_the_next_run_completes_it() {
    let kills = std::env::var("PICOFARM_KILLS").map_or(20, |n| n.parse().expect("a number"));
    let scratch = tempfile::tempdir().unwrap();
    let reference = scratch.path().join("reference");
    let begun = Instant::now();
    publish_all(&reference).await;
    let took = begun.elapsed();
    let whole = objects(&reference).0;
    let (mut killed, mut in_a_put, mut most, mut round) = (0, 0, 0, 0);
    while killed < kills {
        let place = scratch.path().join(format!("round-{round}"));
        let mut random = Lcg(round);
        round += 1;
        let mut harmed: Option<(String, Vec<u8>)> = None;
        let mut here = 0;
        // Repeats until a run finishes or the round has enough kills.
        for _ in 0..12 {
            if killed == kills {
                break;
            }
            let pair = random.next() < 0.3;
            let children: Vec<Child> = (0..1 + usize::from(pair)).map(|_| start(&place)).collect();
            let mut all_ran = true;
            for child in children {
                let wait = took.mul_f32(random.next() * 0.6);
                let ran = kill_after(child, &place, wait);
                (killed, here) = (killed + u64::from(ran), here + usize::from(ran));
                all_ran &= ran;
            }
            let (visible, unfinished) = objects(&place);
            for (key, bytes) in &visible {
                let expected = whole
                    .get(key)
                    .unwrap_or_else(|| panic!("round {round}: {key}"));
                let harm = harmed.as_ref().filter(|(k, _)| k == key);
                let known = bytes == expected || harm.is_some_and(|(_, b)| b == bytes);
                assert!(known, "round {round}, kill {killed}: {key} is torn");
                if bytes == expected && harm.is_some() {
                    harmed = None;
                }
            }
            in_a_put += u64::from(!unfinished.is_empty());
            most = most.max(unfinished.len());
            assert!(
                unfinished.len() <= here * PUTS,
                "round {round}: {unfinished:?}"
            );
            if visible.contains_key("zarr.json") {
                let (store, prefix) = open_store(place.to_str().unwrap()).unwrap();
                let dataset = Dataset::open(store, prefix).await.unwrap();
                let report = dataset.verify(VerifyMode::Full).await.unwrap();
                let known = |p: &Problem| {
                    harmed
                        .as_ref()
                        .is_some_and(|(k, _)| p.object.ends_with(k.as_str()))
                };
                assert!(
                    report.problems.iter().all(known),
                    "round {round}: {report:?}"
                );
            }
            if !all_ran {
                break;
            }
            // An object is damaged: the next process must repair it.
            let published = |k: &&String| {
                k.starts_with("depth/c/")
                    && visible.contains_key(&format!("manifests/{}.json", &k[8..9]))
            };
            if harmed.is_none()
                && random.next() < 0.5
                && let Some(key) = visible.keys().find(published)
            {
                let torn = visible[key][..visible[key].len() / 2].to_vec();
                // The object may be linked to an unfinished file, so a separate file is written.
                fs::remove_file(place.join(key)).unwrap();
                fs::write(place.join(key), &torn).unwrap();
                harmed = Some((key.clone(), torn));
            }
        }
        publish_all(&place).await;
        assert_eq!(objects(&place).0, whole, "round {round}");
        let (store, prefix) = open_store(place.to_str().unwrap()).unwrap();
        let dataset = Dataset::open(store, prefix).await.unwrap();
        dataset.collect(Duration::ZERO, true).await.unwrap();
        let (visible, unfinished) = objects(&place);
        assert!(
            visible == whole && unfinished.is_empty(),
            "round {round}: {unfinished:?}"
        );
        fs::remove_dir_all(&place).unwrap();
    }
    println!(
        "{killed} kills in {round} rounds; after {in_a_put} of them unfinished files lay there, {most} at most; all were \
         collected"
    );
    assert!(in_a_put > 0, "no kill met a put");
}
