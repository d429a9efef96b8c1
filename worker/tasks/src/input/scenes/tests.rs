//! Tests that every scene source must pass. The match in [`named_in_the_suite`] fails to compile
//! for a new source until it has a line here.

use std::fs;

use picofarm_proto::spec::SpecError;
use picofarm_scene::{Intrinsics, export::glb_bytes};
use serde_json::{Value, json};

use super::*;
use crate::submission::Submission;

const COUNT: u64 = 3;
const SIDE: u32 = 24;
const SPOTS: u32 = 4;

fn named_in_the_suite(kind: &SceneKind) -> &'static str {
    match kind {
        SceneKind::Furnished { .. } => "furnished",
        SceneKind::Primitive { .. } => "primitive",
        SceneKind::Files { .. } => "files",
    }
}

struct Place {
    dir: tempfile::TempDir,
    libraries: Vec<AssetLibrary>,
}

impl Place {
    fn new() -> Self {
        Self {
            dir: tempfile::tempdir().unwrap(),
            libraries: find_libraries(&[]),
        }
    }

    fn resolved(&self, text: Value) -> Result<SceneSource, SpecError> {
        let mut source: SceneSource = serde_json::from_value(text).unwrap();
        let here = Submission {
            base: self.dir.path(),
            assets: &[],
        };
        here.scenes(&mut source)?;
        Ok(source)
    }

    fn scene(&self, source: &SceneSource, side: u32, index: u64) -> Result<Scene, TaskError> {
        let size = Resolution::square(side);
        scene(source, size, index, (&self.libraries, &Opener::anywhere()))
    }

    fn glb(&self, source: &SceneSource, side: u32, index: u64) -> Vec<u8> {
        let scene = self.scene(source, side, index);
        glb_bytes(&scene.unwrap_or_else(|e| panic!("{source:?} {index}: {e}"))).unwrap()
    }

    /// Returns every source, resolved as on submission. The scene files are written by the
    /// primitive source.
    fn sources(&self) -> Vec<SceneSource> {
        let made = |kind: &str, more: Value| {
            let mut text = json!({"kind": kind, "count": COUNT, "seed": 5, "spots": SPOTS});
            for (name, value) in more.as_object().unwrap() {
                text[name] = value.clone();
            }
            self.resolved(text).unwrap()
        };
        let primitive = made("primitive", json!({}));
        let desktop = json!({"spots": {"random": SPOTS}, "laser_m": [0.04, -0.02, 0.0]});
        let desktop = made("desktop", desktop);
        let names: Vec<String> = (0..COUNT).map(|i| format!("room {i}.glb")).collect();
        for (i, name) in names.iter().enumerate() {
            let bytes = self.glb(&primitive, 640, i as u64);
            fs::write(self.dir.path().join(name), bytes).unwrap();
        }
        let furnished = made(
            "furnished",
            json!({"assets": "parametric", "min_specular": 2, "floor_plan": "varied"}),
        );
        let files = made("files", json!({"files": names}));
        let mut all = vec![furnished, primitive, files];
        let mut named: Vec<_> = all.iter().map(|s| named_in_the_suite(&s.kind)).collect();
        named.dedup();
        assert_eq!(named.len(), all.len());
        all.push(desktop);
        all
    }
}

#[test]
fn a_scene_depends_on_its_source_and_index_alone() {
    let place = Place::new();
    for source in place.sources() {
        let forwards: Vec<_> = (0..COUNT).map(|i| place.glb(&source, SIDE, i)).collect();
        let other = Place::new();
        for i in (0..COUNT).rev() {
            // Another worker makes the scenes in another order, from leases of one scene each.
            let leased = only(&source, i);
            let again = glb_bytes(&other.scene(&leased, SIDE, i).unwrap()).unwrap();
            assert!(again == forwards[i as usize], "{source:?} {i}");
        }
        for i in 0..COUNT as usize {
            assert!(
                !forwards[..i].contains(&forwards[i]),
                "{source:?} {i} is another's"
            );
        }
    }
}

/// Returns the source as a lease of one task has it.
fn only(source: &SceneSource, index: u64) -> SceneSource {
    let mut leased = source.clone();
    if let SceneKind::Files { files, first, .. } = &mut leased.kind {
        *files = vec![files[index as usize].clone()];
        *first = index;
    }
    leased
}

#[test]
fn a_scene_is_valid_and_as_large_and_lit_as_the_job_says() {
    let place = Place::new();
    for source in place.sources() {
        for i in 0..COUNT {
            let scene = place.scene(&source, SIDE, i).unwrap();
            scene.validate().unwrap();
            let camera = &scene.camera.intrinsics;
            assert_eq!((camera.width, camera.height), (SIDE, SIDE));
            assert_eq!(scene.laser.beams.len(), SPOTS as usize);
            assert!(!scene.objects.is_empty());
            // A higher resolution shows the same room, seen by the same camera.
            let mut finer = place.scene(&source, 2 * SIDE, i).unwrap();
            assert_eq!(finer.camera.intrinsics.width, 2 * SIDE);
            finer.camera.intrinsics = finer.camera.intrinsics.resized(SIDE, SIDE);
            assert_eq!(finer.camera, scene.camera, "{source:?} {i}");
            for (a, b) in finer.laser.beams.iter().zip(&scene.laser.beams) {
                assert!(
                    (a.direction - b.direction).length() < 1e-6,
                    "{source:?} {i}"
                );
            }
            // The beams of a file are cast through its own pixels and rounded.
            finer.laser = scene.laser.clone();
            assert!(
                glb_bytes(&finer).unwrap() == glb_bytes(&scene).unwrap(),
                "{source:?} {i}"
            );
        }
    }
}

#[test]
fn a_scene_written_and_read_again_as_a_file_is_the_same() {
    let place = Place::new();
    for source in place.sources() {
        let bytes = place.glb(&source, SIDE, 1);
        fs::write(place.dir.path().join("again.glb"), &bytes).unwrap();
        let files = json!({"kind": "files", "files": ["again.glb"], "spots": SPOTS});
        let files = place.resolved(files).unwrap();
        assert!(place.glb(&files, SIDE, 0) == bytes, "{source:?}");
    }
}

#[test]
fn another_seed_is_another_room_where_rooms_are_made() {
    let place = Place::new();
    for source in place.sources() {
        let mut other = source.clone();
        other.seed += 1;
        let same = place.glb(&other, SIDE, 0) == place.glb(&source, SIDE, 0);
        let read = matches!(source.kind, SceneKind::Files { .. });
        assert_eq!(same, read, "{source:?}");
    }
}

#[test]
fn resolving_twice_changes_nothing_and_pins_what_may_change() {
    let place = Place::new();
    for source in place.sources() {
        let again = place
            .resolved(serde_json::to_value(&source).unwrap())
            .unwrap();
        assert_eq!(again, source);
        match &source.kind {
            SceneKind::Primitive { .. } => {}
            SceneKind::Furnished { assets, .. } => {
                assert!(assets.starts_with("parametric") && assets.len() > "parametric".len());
                let mut elsewhere = source.clone();
                if let SceneKind::Furnished { assets, .. } = &mut elsewhere.kind {
                    assets.push('0');
                }
                let refused = place.scene(&elsewhere, SIDE, 0).unwrap_err().to_string();
                assert!(refused.contains("scenes.assets"), "{refused}");
            }
            SceneKind::Files { files, .. } => {
                let beyond = place.scene(&source, SIDE, COUNT).unwrap_err().to_string();
                assert!(beyond.contains("scenes.files[3]"), "{beyond}");
                fs::write(&files[1].path, b"another").unwrap();
                let changed = place.scene(&source, SIDE, 1).unwrap_err().to_string();
                assert!(
                    changed.contains("scenes.files[1]") && changed.contains("SHA-256"),
                    "{changed}"
                );
                fs::remove_file(&files[2].path).unwrap();
                let missing = place.scene(&source, SIDE, 2).unwrap_err().to_string();
                assert!(missing.contains("scenes.files[2]"), "{missing}");
            }
        }
    }
}

#[test]
fn a_jobs_view_and_size_replace_those_of_its_files() {
    let place = Place::new();
    let _ = place.sources();
    let size = Resolution {
        width: 32,
        height: 24,
    };
    let read = |more: Value| {
        let mut text = json!({"kind": "files", "files": ["room*.glb"], "spots": SPOTS});
        for (name, value) in more.as_object().unwrap() {
            text[name] = value.clone();
        }
        let source = place.resolved(text)?;
        assert_eq!(source.count, COUNT);
        let with = (&place.libraries[..], &Opener::anywhere());
        Ok::<_, SpecError>(scene(&source, size, 1, with).unwrap())
    };
    let own = read(json!({})).unwrap();
    let i = own.camera.intrinsics;
    assert_eq!((i.width, i.height), (32, 24));
    assert!((i.fx - i.fy).abs() < 1e-4, "square pixels: {i:?}");
    let moved = json!({"look_from": [0.5, 1.5, 1], "look_at": [0, 1, 0], "fov_deg": 40});
    let moved = read(moved).unwrap();
    assert_eq!(moved.camera.origin, Vec3::new(0.5, 1.5, 1.0));
    let wide = Intrinsics::from_fov(40.0, 32, 24);
    assert!((moved.camera.intrinsics.fx - wide.fx).abs() < 1e-3);
    // The files' beams stay where they are, unless the job replaces them.
    assert_eq!(moved.laser.origin, own.laser.origin);
    let replaced = read(json!({"replace_laser": true, "look_from": [0.5, 1.5, 1]})).unwrap();
    assert_eq!(replaced.laser.origin, replaced.camera.origin);
    let small = read(json!({"unit": "mm"})).unwrap();
    let wide = |scene: &Scene| scene.path_range_m().unwrap()[1];
    assert!((wide(&small) / wide(&own) - 1e-3).abs() < 1e-4);
}
