//! Numbers of a job outside any sensible range are refused with the field, the value, the range and
//! the correct form. Those at the ends of their ranges pass.

use picofarm_proto::spec::{JobSpec, parse_share};
use serde_json::{Value, json};

fn job() -> Value {
    json!({
        "name": "n",
        "stage": [
            {"name": "render", "scenes": {"kind": "furnished", "count": 4, "seed": 1}, "render": {"samples": 8},
             "output": {"store": "/s", "dataset": "rooms"}},
            {"name": "noise", "kind": "reprocess", "source": "render", "reprocess": {"sensor": {}},
             "output": {"store": "/s", "dataset": "noisy", "profile": "counts-u16"}},
            {"name": "train", "kind": "train", "source": "render",
             "train": {"target": "tof", "model": "m", "input": {}, "net": {}, "optimise": {}}},
            {"name": "report", "kind": "report", "report": {"name": "r", "models": ["train"]}},
        ],
        "limits": {},
    })
}

/// Returns the job with a value at a path such as `stage/0/render/bins`.
fn with(at: &str, value: Value) -> Result<JobSpec, String> {
    let mut job = job();
    let (parent, field) = at.rsplit_once('/').unwrap_or(("", at));
    let parent = if parent.is_empty() {
        String::new()
    } else {
        format!("/{parent}")
    };
    job.pointer_mut(&parent)
        .and_then(Value::as_object_mut)
        .unwrap_or_else(|| panic!("no {parent}"))
        .insert(field.into(), value);
    let spec: JobSpec = serde_json::from_value(job).map_err(|e| e.to_string())?;
    spec.check().map_err(|e| e.to_string())?;
    Ok(spec)
}

#[test]
fn what_cannot_be_meant_is_refused_with_the_field_the_value_and_the_range() {
    for (at, value, parts) in [
        // Picoseconds instead of metres.
        (
            "stage/0/render/bin_width_m",
            json!(128),
            ["render.bin_width_m", "128", "1 ps is 0.0002998 m"],
        ),
        (
            "stage/0/render/bin_width_m",
            json!(0),
            ["render.bin_width_m", "0 lies outside", "0.000001..=10"],
        ),
        (
            "stage/0/render/gate_start_m",
            json!(-0.5),
            ["render.gate_start_m", "-0.5", "0..=10000"],
        ),
        (
            "stage/0/render/gate_start_m",
            json!(1e9),
            ["render.gate_start_m", "1000000000", "metres"],
        ),
        (
            "stage/0/render/samples",
            json!(0),
            ["render.samples", "0 lies outside", "2..=1048576"],
        ),
        (
            "stage/0/render/resolution",
            json!(0),
            ["render.resolution", "0 lies", "1..=4096"],
        ),
        (
            "stage/0/render/resolution",
            json!(4097),
            ["render.resolution", "4097", "1..=4096"],
        ),
        (
            "stage/0/render/bins",
            json!(70_000),
            ["render.bins", "70000", "1..=65536"],
        ),
        (
            "stage/0/scenes/fov_deg",
            json!(180),
            ["scenes.fov_deg", "180", "20..=120"],
        ),
        (
            "stage/0/scenes/spots",
            json!(9),
            ["scenes.spots", "9", "1, 4, 16, 25 and 100"],
        ),
        (
            "stage/0/scenes/spots",
            json!({"random": 0}),
            ["scenes.spots", "random = 0", "1 to 100 spots"],
        ),
        (
            "stage/0/scenes/spots",
            json!({"at": [[0.5, 1.0]]}),
            ["scenes.spots", "[0.5, 1]", "from 0 up to 1"],
        ),
        (
            "stage/0/scenes/spots",
            json!("many"),
            ["scenes.spots", "many", "{ random = N }"],
        ),
        (
            "stage/0/scenes/laser_m",
            json!([0.0, 9.0, 0.0]),
            ["scenes.laser_m", "9 lies", "metres"],
        ),
        (
            "stage/0/scenes/rooms",
            json!({"scale": [1.0, 2.0]}),
            ["scenes.rooms", "furnished", "desktop"],
        ),
        (
            "stage/2/train/depth_scale_m",
            json!(0),
            ["train.depth_scale_m", "0 lies", "metres"],
        ),
        (
            "stage/0/scenes/min_specular",
            json!(1000),
            ["scenes.min_specular", "1000", "0..=16"],
        ),
        (
            "stage/0/scenes/count",
            json!(0),
            ["scenes.count", "0 lies", "1..=100000000"],
        ),
        (
            "stage/0/scenes/seed",
            json!(-1),
            ["scenes.seed", "-1", "a whole number from 0"],
        ),
        (
            "stage/0/resources",
            json!({"cores": 100_000}),
            ["resources.cores", "100000", "0..=65536"],
        ),
        (
            "stage/0/resources",
            json!({"memory_gib": -1}),
            ["resources.memory_gib", "-1", "GiB"],
        ),
        (
            "stage/0/resources",
            json!({"gpus": 5000}),
            ["resources.gpus", "5000", "0..=1"],
        ),
        ("stage/0/parts", json!(0), ["parts", "0 lies", "1..=1024"]),
        (
            "stage/1/reprocess/sensor",
            json!({"rebin": 0}),
            ["sensor.rebin", "0 lies", "1 leaves them"],
        ),
        (
            "stage/1/reprocess/sensor",
            json!({"dark_per_bin": -1}),
            ["dark_per_bin", "-1", "photons a bin"],
        ),
        (
            "stage/2/train/optimise",
            json!({"learning_rate": 0}),
            ["train.optimise.learning_rate", "0 lies", "0.01 is usual"],
        ),
        (
            "stage/2/train/optimise",
            json!({"weight_decay": 2}),
            ["weight_decay", "2 lies", "0.001 is usual"],
        ),
        (
            "stage/2/train/optimise",
            json!({"epochs": 0}),
            ["optimise.epochs", "0 lies", "1..=1000000"],
        ),
        (
            "stage/2/train/net",
            json!({"levels": 1}),
            ["net.levels", "1 lies", "2..=8"],
        ),
        (
            "stage/2/train/checkpoint_minutes",
            json!(-1),
            ["checkpoint_minutes", "-1 lies", "minutes"],
        ),
        (
            "stage/3/report/pictures",
            json!(1000),
            ["report.pictures", "1000", "0..=100"],
        ),
        (
            "limits",
            json!({"max_crashes": 0}),
            ["limits.max_crashes", "0 lies", "1..=1000000"],
        ),
        (
            "limits",
            json!({"max_interruptions": 0}),
            ["limits.max_interruptions", "0 lies", "1..=1000000"],
        ),
        (
            "limits",
            json!({"max_workers": 2_000_000}),
            ["limits.max_workers", "2000000", "0 is as many"],
        ),
    ] {
        let said = with(at, value.clone()).expect_err(&format!("{at} = {value}"));
        for part in parts {
            assert!(
                said.contains(part),
                "{at} = {value}: {part:?} is not in {said:?}"
            );
        }
    }
    with("name", json!("as it is")).unwrap();
    for (at, value) in [
        ("stage/0/render/bin_width_m", json!(10)),
        ("stage/0/render/bin_width_m", json!(1e-6)),
        ("stage/0/render/gate_start_m", json!(0)),
        ("stage/0/render/samples", json!(2)),
        ("stage/0/render/resolution", json!(4096)),
        ("stage/0/scenes/fov_deg", json!(120)),
        ("stage/0/scenes/spots", json!({"random": 100})),
        ("stage/0/scenes/spots", json!({"at": [[0.0, 0.999]]})),
        ("stage/0/scenes/laser_m", json!([5.0, -5.0, 0.0])),
        ("stage/2/train/depth_scale_m", json!(1.27)),
        ("stage/2/train/optimise", json!({"learning_rate": 10})),
        ("limits", json!({"max_crashes": 1_000_000})),
        ("limits", json!({"max_interruptions": 1})),
    ] {
        with(at, value.clone()).unwrap_or_else(|e| panic!("{at} = {value}: {e}"));
    }
}

#[test]
fn a_share_is_a_percentage_or_a_fraction_and_never_more_than_all() {
    for (text, share) in [("10%", 0.1), ("0.1", 0.1), (" 5 % ", 0.05), ("99%", 0.99)] {
        assert!((parse_share(text).unwrap() - share).abs() < 1e-12);
    }
    let said = parse_share("10").unwrap_err();
    assert!(
        said.contains("1000 %") && said.contains("did you mean \"10%\""),
        "{said}"
    );
    for text in ["0", "-5%", "100%", "1", "nan", "inf", "250%", "ten", ""] {
        let said = parse_share(text).unwrap_err();
        assert!(said.contains("10%"), "{text}: {said}");
    }
}

#[test]
fn an_unknown_kind_is_named_first_and_with_the_one_that_was_meant() {
    for (at, value, parts) in [
        // The error once attributed `assets` to another kind.
        (
            "stage/0/scenes",
            json!({"kind": "furnshed", "assets": "auto", "count": 1}),
            ["scenes.kind", "\"furnshed\"", "did you mean \"furnished\"?"],
        ),
        (
            "stage/1/kind",
            json!("reproces"),
            ["kind", "\"reproces\"", "did you mean \"reprocess\"?"],
        ),
        (
            "stage/2/train/target",
            json!("shadows"),
            ["train.target", "`shadows`", "did you mean `shadow`?"],
        ),
        (
            "stage/2/train/histogram",
            json!("transient4"),
            [
                "train.histogram",
                "`transient4`",
                "did you mean `transient_4`?",
            ],
        ),
        (
            "stage/2/train/net",
            json!({"architecture": "unet2.5d"}),
            [
                "train.net.architecture",
                "`unet2.5d`",
                "did you mean `unet25d`?",
            ],
        ),
        (
            "stage/2/train/optimise",
            json!({"schedule": "onecyle"}),
            [
                "train.optimise.schedule",
                "`onecyle`",
                "did you mean `onecycle`?",
            ],
        ),
        (
            "stage/2/train/input",
            json!({"normalize": "log"}),
            ["train.input", "`normalize`", "did you mean `normalise`?"],
        ),
        (
            "stage/0/render/resolutoin",
            json!(8),
            ["render", "`resolutoin`", "did you mean `resolution`?"],
        ),
    ] {
        let said = with(at, value.clone()).expect_err(&format!("{at} = {value}"));
        for part in parts {
            assert!(
                said.contains(part),
                "{at} = {value}: {part:?} is not in {said:?}"
            );
        }
    }
}
