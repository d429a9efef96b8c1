//! Errors about a description name the field, its form, and an example.

use std::path::Path;

use picofarm_exchange::capture::import;
use picofarm_files::Opener;
use tempfile::TempDir;

use crate::files::npy::npy;

fn said(folder: &Path, description: &str) -> String {
    let file = folder.join("a.npy");
    std::fs::write(&file, npy("<f4", &[2, 2, 8], &[1.0f32; 32])).unwrap();
    std::fs::write(folder.join("capture.json"), description).unwrap();
    import(&[file], None, &Opener::anywhere())
        .unwrap_err()
        .to_string()
}

#[test]
fn a_field_of_another_form_is_named_with_its_form_and_an_example() {
    let folder = TempDir::new().unwrap();
    for (description, words) in [
        (
            r#"{"laser_m": "0.1,0,0"}"#,
            ["laser_m", "three numbers in metres", "[0.10, 0.0, 0.0]"],
        ),
        (
            r#"{"laser_m": [0.1, 0]}"#,
            ["laser_m", "three numbers in metres", "found [0.1,0]"],
        ),
        (
            r#"{"axes": "row"}"#,
            ["axes", "a list of names", "[\"row\", \"column\", \"bin\"]"],
        ),
        (
            r#"{"gate": {"t0": 4}}"#,
            ["gate", "numbers by name", "\"t0_ps\": 14242.8"],
        ),
        (
            r#"{"camera": 60}"#,
            ["camera", "numbers by name", "\"fov_deg\": 60.0"],
        ),
        (
            r#"{"pixels": [2]}"#,
            ["pixels", "two whole numbers", "[64, 64]"],
        ),
        (
            r#"{"frame": ["right"]}"#,
            ["frame", "three axes", "\"forward\""],
        ),
    ] {
        let said = said(folder.path(), description);
        for word in words {
            assert!(said.contains(word), "{description}: {word}: {said}");
        }
    }
}

#[test]
fn an_unknown_axis_and_one_named_twice_are_told_apart() {
    let folder = TempDir::new().unwrap();
    let unknown = said(folder.path(), r#"{"axes": ["row", "col", "bin"]}"#);
    assert!(unknown.contains("found \"col\" in"), "{unknown}");
    let twice = said(folder.path(), r#"{"axes": ["row", "row", "bin"]}"#);
    assert!(twice.contains("each axis once"), "{twice}");
}
