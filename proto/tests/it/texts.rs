//! Texts of jobs that are too long or control terminals are refused, with the names of their
//! fields.

use picofarm_proto::spec::{
    JobSpec,
    bounds::{NAME_BYTES, PLACE_BYTES, TEXT_BYTES, steers},
};

fn spec() -> serde_json::Value {
    serde_json::json!({"name": "n", "scenes": {"kind": "primitive", "count": 3},
        "render": {"renderer": "r1"}, "resources": {"labels": ["a", "b"]},
        "output": {"store": "file:///s", "dataset": "d"}})
}

fn refused(at: &str, value: &str) -> String {
    let mut job = spec();
    *job.pointer_mut(at).unwrap() = value.into();
    let spec: JobSpec = serde_json::from_value(job).unwrap();
    spec.check().unwrap_err().to_string()
}

#[test]
fn a_text_of_a_job_with_a_control_character_is_refused_by_its_field() {
    for steering in ["\0", "\u{1b}[2J", "\n", "\u{7f}", "\u{202e}"] {
        let text = format!("x{steering}y");
        for (at, field) in [
            ("/name", "name: holds"),
            ("/output/store", "output.store: holds"),
            ("/output/dataset", "output.dataset: holds"),
            ("/render/renderer", "render.renderer: holds"),
            ("/resources/labels/1", "resources.labels.1: holds"),
        ] {
            let why = refused(at, &text);
            assert!(why.starts_with(field), "{at}: {why}");
            assert!(!why.chars().any(steers), "{why:?}");
        }
    }
}

#[test]
fn a_text_of_a_job_that_is_too_long_is_refused_with_the_length_allowed() {
    for (at, most) in [
        ("/name", NAME_BYTES),
        ("/output/dataset", NAME_BYTES),
        ("/output/store", PLACE_BYTES),
        ("/render/renderer", TEXT_BYTES),
    ] {
        let why = refused(at, &"x".repeat(most + 1));
        assert!(why.contains(&format!("at most {most}")), "{at}: {why}");
        assert!(why.len() < 200, "the text itself is not repeated: {why}");
    }
}

#[test]
fn in_a_job_of_several_stages_the_error_names_the_stage() {
    let mut job = serde_json::json!({"name": "n", "stage": [spec(), spec()]});
    for stage in job["stage"].as_array_mut().unwrap() {
        stage.as_object_mut().unwrap().remove("name");
    }
    job["stage"][1]["name"] = "second".into();
    job["stage"][1]["output"]["dataset"] = "a\0".into();
    let spec: JobSpec = serde_json::from_value(job).unwrap();
    let why = spec.check().unwrap_err();
    assert_eq!(why.field, "stage.second.output.dataset");
}
