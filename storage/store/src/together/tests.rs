//! Tests of the store in a folder.

use super::*;
use crate::open_store;

/// Returns the names of all files below a folder, relative to it.
fn names(folder: &Folder) -> Vec<String> {
    let (mut folders, mut found) = (vec![folder.to_owned()], Vec::new());
    while let Some(at) = folders.pop() {
        for entry in fs::read_dir(at).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => found.push(path.strip_prefix(folder).unwrap().display().to_string()),
            }
        }
    }
    found.sort();
    found
}

#[tokio::test]
async fn a_manifest_is_created_with_its_objects_unless_one_of_them_exists() {
    let folder = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(&folder.path().display().to_string()).unwrap();
    let at = |key: &str| objects::path_of(&prefix, key);
    let pair = |scene: u32| {
        let key = |name: &str| at(&format!("{name}/c/{scene}/0"));
        [
            (key("a"), Bytes::from("first")),
            (key("b"), Bytes::from("second")),
        ]
    };
    let manifest = |scene: u32| (at(&format!("manifests/{scene}.json")), Bytes::from("{}"));
    let (path, bytes) = manifest(0);
    let made = create_together(&*store, &pair(0), (&path, bytes.clone())).await;
    assert!(made.unwrap());
    let first = ["a/c/0/0", "b/c/0/0", "manifests/0.json"];
    assert_eq!(names(folder.path()), first);
    let again = create_together(&*store, &pair(0), (&path, bytes)).await;
    assert!(!again.unwrap(), "all exist");

    // A killed writer left an object.
    let (path, bytes) = manifest(1);
    objects::create(&*store, &pair(1)[1].0, "other".into())
        .await
        .unwrap();
    let made = create_together(&*store, &pair(1), (&path, bytes.clone())).await;
    assert!(!made.unwrap());
    let left = [
        "a/c/0/0",
        "a/c/1/0",
        "b/c/0/0",
        "b/c/1/0",
        "manifests/0.json",
    ];
    assert_eq!(
        names(folder.path()),
        left,
        "no manifest, and no staged file"
    );
    let kept = objects::get(&*store, &pair(1)[1].0).await.unwrap();
    assert_eq!(kept.as_deref(), Some(&b"other"[..]));
    assert!(
        create_last(&*store, &pair(1), (&path, bytes.clone()))
            .await
            .unwrap()
    );
    assert!(
        !create_last(&*store, &pair(1), (&path, bytes))
            .await
            .unwrap()
    );
}

#[tokio::test]
async fn objects_that_are_missing_or_of_another_size_are_none() {
    let folder = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(&folder.path().display().to_string()).unwrap();
    let memory = object_store::memory::InMemory::new();
    for store in [&*store, &memory as &dyn ObjectStore] {
        let at = |key: &str| objects::path_of(&prefix, key);
        objects::create(store, &at("a"), "abc".into())
            .await
            .unwrap();
        let asked = [(at("a"), 3), (at("a"), 2), (at("b"), 3)];
        let found = get_sized(store, &asked).await.unwrap();
        assert_eq!(found, [Some(Bytes::from("abc")), None, None]);
    }
}

#[test]
fn files_and_new_folders_are_flushed_one_by_one_where_the_file_system_cannot_do_it() {
    let folder = tempfile::tempdir().unwrap();
    let mut unflushed = Unflushed::default();
    let path = folder.path().join("a/b/c");
    let staged = unflushed.stage(&path, &"abc".into()).unwrap();
    assert_eq!(fs::read(staged).unwrap(), b"abc");
    let changed = ["", "a", "a/b"].map(|name| folder.path().join(name));
    assert!(changed.iter().all(|folder| {
        let same = |f: &PathBuf| f.components().eq(folder.components());
        unflushed.folders.iter().any(same)
    }));
    unflushed.flush_each().unwrap();
}
