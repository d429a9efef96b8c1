//! The keys of manifests.

use crate::layout::manifest::Manifest;

/// Returns the scene of the manifest with this key.
pub(crate) fn manifest_scene(key: &str) -> Option<u64> {
    let scene = key
        .strip_prefix("manifests/")?
        .strip_suffix(".json")?
        .parse()
        .ok()?;
    (Manifest::key(scene) == key).then_some(scene)
}
