//! Stages that calibrate: what they refuse.

use picofarm_proto::spec::JobSpec;

fn refused(fields: &str) -> String {
    let text = format!(
        r#"{{"name": "lab", "stage": [{{"kind": "calibrate", "source": {{"store": "/s", "dataset": "a"}},
            "output": {{"store": "/s", "dataset": "b"}}{fields}}}]}}"#
    );
    let job: Result<JobSpec, _> = serde_json::from_str(&text);
    match job {
        Err(e) => e.to_string(),
        Ok(job) => match job.stages[0].task.check() {
            Err(e) => e.to_string(),
            Ok(()) => String::new(),
        },
    }
}

#[test]
fn a_source_of_several_scenes_and_no_pulses_are_refused_with_their_field() {
    assert_eq!(refused(r#", "count": 1"#), "");
    let several = refused(r#", "count": 4"#);
    assert!(
        several.contains("source") && several.contains("4 scenes"),
        "{several}"
    );
    let pulses = refused(r#", "count": 1, "calibrate": {"pulses": 0}"#);
    assert!(pulses.contains("calibrate.pulses"), "{pulses}");
    let unknown = refused(r#", "count": 1, "calibrate": {"pulse": 7}"#);
    assert!(unknown.contains("pulse"), "{unknown}");
}

#[test]
fn a_calibration_into_its_own_source_is_refused() {
    let text = r#"{"name": "lab", "stage": [{"kind": "calibrate", "count": 1,
        "source": {"store": "/s", "dataset": "a"}, "output": {"store": "/s", "dataset": "a"}}]}"#;
    let job: JobSpec = serde_json::from_str(text).unwrap();
    let said = job.stages[0].task.check().unwrap_err().to_string();
    assert!(said.contains("is the source itself"), "{said}");
}
