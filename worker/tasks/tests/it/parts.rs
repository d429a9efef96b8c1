//! Parts of a scene through the executor: the scene is the same whatever happens to its parts.

use crate::common;

use std::{
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use common::{spec, stage};
use picofarm_files::Opener;
use picofarm_proto::{
    ids::JobId,
    key::stage_key,
    spec::{Budget, PartTask, RenderTask, StageSpec, TaskSpec},
};
use picofarm_settings::{Resolution, Wavelength};
use picofarm_tasks::{Control, Executor, Output, Task, TaskError, TaskExecutor};
use tokio::runtime::Handle;
use uuid::Uuid;

const PARTS: u32 = 3;

fn heavy(store: &Path) -> RenderTask {
    let mut spec = spec(store.to_str().unwrap());
    spec.render.resolution = Resolution::square(40);
    spec.render.budget = Budget::Samples(3);
    spec.render.max_bounces = 0;
    spec.render.optics.wavelengths_nm = Wavelength::of(&[611.4]).unwrap();
    spec
}

fn parts_of(whole: RenderTask) -> StageSpec {
    StageSpec::new(TaskSpec::Part(PartTask { whole }))
}

async fn run(stage: StageSpec, index: u64) -> Result<Output, TaskError> {
    let task = Task {
        job: JobId::from_uuid(Uuid::nil()),
        stage: stage_key(&stage),
        spec: Arc::new(stage),
        index,
    };
    let runtime = Handle::current();
    let work =
        move || TaskExecutor::new(&[], runtime, Opener::anywhere()).run(&task, &Control::default());
    tokio::task::spawn_blocking(work).await.unwrap()
}

/// Returns the contents of all files by path.
fn objects(at: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = vec![];
    let mut folders = vec![at.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(at).unwrap().to_owned();
                found.push((name, fs::read(path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

fn names(objects: &[(PathBuf, Vec<u8>)]) -> Vec<String> {
    let parts = objects
        .iter()
        .filter(|(path, _)| path.starts_with("tiny/parts"));
    parts
        .map(|(path, _)| path.file_name().unwrap().to_str().unwrap().to_owned())
        .collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_that_are_damaged_missing_or_swapped_are_made_up_for_and_all_are_deleted_in_the_end()
{
    let here = tempfile::tempdir().unwrap();
    let place = |name: &str| here.path().join(name);
    run(stage(heavy(&place("whole"))), 4).await.unwrap();
    let expected = objects(&place("whole"));

    let store = place("parts");
    let whole = RenderTask {
        parts: PARTS,
        ..heavy(&store)
    };
    let each = u64::from(PARTS) + 1;
    for part in 0..each {
        let made = run(parts_of(whole.clone()), 4 * each + part).await.unwrap();
        assert!(!made.adopted && made.bytes > 0, "{made:?}");
        let found = run(parts_of(whole.clone()), 4 * each + part).await.unwrap();
        assert!(found.adopted, "it is there already");
        assert_eq!(made.manifest_sha256, found.manifest_sha256);
    }
    let there = objects(&store);
    assert_eq!(
        names(&there),
        ["0-of-3.zst", "1-of-3.zst", "2-of-3.zst", "3-of-3.zst"]
    );
    let path = |name: &str| {
        let all = there.iter().map(|(path, _)| path);
        store.join(all.clone().find(|p| p.ends_with(name)).unwrap())
    };
    let mut bytes = fs::read(path("1-of-3.zst")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs::write(path("1-of-3.zst"), bytes).unwrap();
    fs::remove_file(path("2-of-3.zst")).unwrap();
    fs::copy(path("3-of-3.zst"), path("0-of-3.zst")).unwrap();

    let joined = run(stage(whole.clone()), 4).await.unwrap();
    assert!(!joined.adopted);
    assert_eq!(objects(&store), expected);

    // A part that arrives late or is requested again is not rendered, because the scene exists.
    let late = run(parts_of(whole.clone()), 4 * each + 2).await.unwrap();
    assert!(late.adopted && late.bytes == 0, "{late:?}");
    assert_eq!(objects(&store), expected);
}
