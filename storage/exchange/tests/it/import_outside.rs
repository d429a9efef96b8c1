//! Tests that an import reads only permitted files, whether they are named in its files or reached
//! by links in its folders.

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use picofarm_exchange::import::*;
use picofarm_files::Opener;
use serde_json::json;

const SECRET: &str = "root:x:0:0:hunter2\n";

struct Place {
    dir: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(dir.path().join("data/scene")).unwrap();
        std::fs::write(dir.path().join("secret.npy"), SECRET).unwrap();
        Self { dir }
    }

    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.data().join("scene").join(name), text).unwrap();
    }

    fn link(&self, name: &str) {
        let link = self.data().join("scene").join(name);
        let _ = std::fs::remove_file(&link);
        symlink(self.dir.path().join("secret.npy"), link).unwrap();
    }

    /// Returns names of the secret that a file in the scene's folder may use.
    fn tricks(&self) -> Vec<String> {
        let whole = self.dir.path().join("secret.npy").display().to_string();
        vec![
            "../../secret.npy".into(),
            "./../../secret.npy".into(),
            "a/../../../secret.npy".into(),
            "..\\..\\secret.npy".into(),
            "\\\\server\\share\\secret.npy".into(),
            format!("file://{whole}"),
            whole,
        ]
    }

    /// Returns the error of an import within `prefix`.
    fn said(&self, format: Format, prefix: Option<&Path>) -> String {
        let opener = prefix.map_or(Opener::anywhere(), |p| Opener::anywhere().within([p]));
        let options = ImportOptions::default();
        let read = Source::open_within(&self.data(), Some(format), options, None, &opener)
            .and_then(|source| import_scene(&source, 0));
        let said = read.map(drop).unwrap_err().to_string();
        assert!(
            !said.contains("hunter2") && !said.contains("root:"),
            "{said}"
        );
        said
    }
}

fn npy_scene(histogram: &str, spots: &str) -> String {
    json!({
        "format": "picofarm-scene-1", "length_unit": "m",
        "histogram": {"file": histogram, "axes": ["row", "column", "bin"],
                      "gate_start": 0.0, "bin_width": 0.1, "gate_unit": "length"},
        "camera": {"fx": 2.0, "fy": 2.0, "cx": 2.0, "cy": 2.0, "pixel_centre": 0.5,
                   "axes": ["right", "down", "forward"]},
        "laser": [0.0, 0.0, 0.0], "spots": {"file": spots}, "depth": {"file": "depth.npy", "kind": "z"},
    })
    .to_string()
}

fn platonerf_scene(name: &str) -> String {
    let identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
    json!({"camera_angle_x": 60.0, "walls": [], "frames": [{
        "file_path": name, "transform_matrix": identity,
        "light_origin": [0.0, 0.0, 0.0], "light_direction": [0.0, 0.0, -1.0],
    }]})
    .to_string()
}

#[test]
fn names_in_files_stay_in_the_scenes_folder_whatever_is_allowed() {
    let place = Place::new();
    for name in place.tricks() {
        place.write("scene.json", &npy_scene(&name, "spots.npy"));
        let said = place.said(Format::Npy, None);
        assert!(said.contains("is not opened"), "{name}: {said}");
        std::fs::remove_file(place.data().join("scene/scene.json")).unwrap();
        place.write("transforms_train.json", &platonerf_scene(&name));
        let said = place.said(Format::Platonerf, None);
        assert!(said.contains("is not opened"), "{name}: {said}");
        std::fs::remove_file(place.data().join("scene/transforms_train.json")).unwrap();
    }
}

#[test]
fn links_lead_nowhere_outside_of_an_operators_prefixes() {
    let place = Place::new();
    let prefix = place.data();
    let within = |format| place.said(format, Some(&prefix));
    let refused = |format: Format, what: &str| {
        let said = within(format);
        assert!(said.contains("is not opened"), "{what}: {said}");
    };
    place.write("scene.json", &npy_scene("h.npy", "spots.npy"));
    place.link("h.npy");
    refused(Format::Npy, "histogram");
    place.link("scene.json");
    refused(Format::Npy, "scene.json");
    std::fs::remove_file(place.data().join("scene/scene.json")).unwrap();

    place.write("transforms_train.json", &platonerf_scene("./h"));
    refused(Format::Platonerf, "capture");
    place.link("transforms_train.json");
    refused(Format::Platonerf, "transforms");
    std::fs::remove_file(place.data().join("scene/transforms_train.json")).unwrap();

    place.link("detector_scan_8x6.mat");
    place.write("spot_1.mat", "");
    refused(Format::BfLidar, "scan");
    place.link("spot_1.mat");
    refused(Format::BfLidar, "capture");

    place.write("depth.exr", "");
    place.link("lidar_4.exr");
    std::fs::remove_file(place.data().join("scene/depth.exr")).unwrap();
    place.link("depth.exr");
    refused(Format::Sb3d, "depth");
}

#[test]
fn a_folder_that_is_a_link_and_a_root_outside_are_refused() {
    let place = Place::new();
    let other = place.dir.path().join("other");
    std::fs::create_dir(&other).unwrap();
    std::fs::write(other.join("scene.json"), SECRET).unwrap();
    symlink(&other, place.data().join("elsewhere")).unwrap();
    let prefix = place.data();
    let said = place.said(Format::Npy, Some(&prefix));
    assert!(said.contains("elsewhere is not opened"), "{said}");
    // Without prefixes, links are the reader's own responsibility; nevertheless, content other than
    // JSON is not quoted.
    let said = place.said(Format::Npy, None);
    assert!(said.contains("scene.json"), "{said}");
    let said = place.said(Format::Npy, Some(&other));
    assert!(said.contains("is not opened"), "{said}");
}
