//! Reads the contents of a store: every object's hash and time, the scenes of a data set, and files
//! left by killed writers.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    time::SystemTime,
};

use sha2::{Digest, Sha256};

/// Name of the object in a store's root with its identity, which is unique to the store.
const IDENTITY: &str = ".picofarm-store.json";

/// Returns the SHA-256 of every object under a folder, by its path in it. Omits the identity of a
/// store, and the unfinished files `name#1` of killed writers, which no reader sees.
///
/// # Panics
/// If a file cannot be read.
pub fn hashes(folder: &Path) -> BTreeMap<String, String> {
    let hash = |path: &Path| hex::encode(Sha256::digest(read(path)));
    files(folder)
        .into_iter()
        .map(|(name, path)| (name, hash(&path)))
        .collect()
}

/// Returns the modification time of each object under a folder.
///
/// # Panics
/// If the metadata of a file cannot be read.
pub fn times(folder: &Path) -> BTreeMap<String, SystemTime> {
    let time = |path: &Path| {
        let modified = fs::metadata(path).and_then(|m| m.modified());
        modified.unwrap_or_else(|e| panic!("{}: {e}", path.display()))
    };
    files(folder)
        .into_iter()
        .map(|(name, path)| (name, time(&path)))
        .collect()
}

/// Returns the finished scenes, by their manifests in the data set at `place`.
pub fn finished(place: &Path) -> Vec<u64> {
    let mut scenes: Vec<u64> = fs::read_dir(place.join("manifests"))
        .into_iter()
        .flatten()
        .filter_map(|entry| {
            entry
                .ok()?
                .file_name()
                .to_str()?
                .strip_suffix(".json")?
                .parse()
                .ok()
        })
        .collect();
    scenes.sort_unstable();
    scenes
}

/// Returns the manifest of a scene.
///
/// # Panics
/// If it is missing or is not JSON.
pub fn manifest(place: &Path, scene: u64) -> serde_json::Value {
    let path = place.join(format!("manifests/{scene}.json"));
    serde_json::from_slice(&read(&path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Returns the objects of a scene, including its manifest, by their keys in the data set.
///
/// # Panics
/// If the manifest is missing or invalid.
pub fn objects(place: &Path, scene: u64) -> Vec<String> {
    let manifest = manifest(place, scene);
    let objects = manifest["objects"]
        .as_array()
        .expect("a manifest lists objects");
    let keys = objects
        .iter()
        .map(|o| o["key"].as_str().expect("objects have keys").to_owned());
    keys.chain([format!("manifests/{scene}.json")]).collect()
}

fn read(path: &Path) -> Vec<u8> {
    fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn files(folder: &Path) -> BTreeMap<String, PathBuf> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        let entries = fs::read_dir(&next).unwrap_or_else(|e| panic!("{}: {e}", next.display()));
        for entry in entries {
            let path = entry.expect("a folder can be listed").path();
            let name = path
                .strip_prefix(folder)
                .expect("found under it")
                .display()
                .to_string();
            if path.is_dir() {
                folders.push(path);
            } else if !unfinished(&name) && name != IDENTITY {
                found.insert(name, path);
            }
        }
    }
    found
}

/// Returns the unfinished files `name#1` of killed writers under a folder.
pub fn leftovers(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if unfinished(&path.display().to_string()) {
                found.push(path);
            }
        }
    }
    found
}

fn unfinished(name: &str) -> bool {
    let number = name.rsplit_once('#').map(|(_, n)| n);
    number.is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
}
