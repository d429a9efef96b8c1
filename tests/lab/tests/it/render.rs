//! `just lab render` prints its tables, one JSON document and a picture. The tests do not
//! check times.

use std::path::Path;

use picofarm_tests::{Cli, Scratch};

const TINY: [&str; 12] = [
    "render",
    "primitive",
    "--resolution",
    "16",
    "--spots",
    "4",
    "--ladder",
    "4,16",
    "--bins",
    "64",
    "--bin-width-m",
    "0.384",
];

/// Runs the lab in a folder.
fn lab(scratch: &Scratch) -> Cli {
    Cli::new(scratch.path()).of_program(Path::new(env!("CARGO_BIN_EXE_picofarm-lab")))
}

#[test]
fn a_tiny_benchmark_prints_tables_json_and_a_picture() {
    let scratch = Scratch::new("bench");
    let lab = lab(&scratch);
    let peer = serde_json::json!({"tool": "other 1.0", "runs": [{
        "scene": "primitive-1", "mode": "slow", "width": 16, "height": 16, "bins": 64, "spots": 4,
        "rungs": [
            {"samples": 1, "cpu_seconds": 100.0, "error": 0.2},
            {"samples": 4, "cpu_seconds": 400.0, "error": 0.1},
        ],
    }]});
    std::fs::write(scratch.join("peer.json"), peer.to_string()).unwrap();
    let ended = lab
        .run(
            &[
                &TINY[..],
                &[
                    "--error",
                    "30%,10%",
                    "--peer",
                    "peer.json",
                    "--plot",
                    "plot.png",
                ],
            ]
            .concat(),
        )
        .ok();
    for part in [
        "primitive-1: 16x16 pixels x 64 bins, 4 spots",
        "until 30 %",
        "CPU s to",
        "other 1.0 slow",
        "ratio",
    ] {
        assert!(ended.stdout.contains(part), "{part:?} in {}", ended.stdout);
    }
    assert!(ended.stdout.is_ascii());
    let png = std::fs::read(scratch.join("plot.png")).unwrap();
    assert!(png.starts_with(b"\x89PNG\r\n\x1a\n") && png.len() > 1000);

    let found = lab.json(&[&TINY[..], &["--error", "30%", "--strategies"]].concat());
    let scene = &found["scenes"][0];
    let variants = scene["variants"].as_array().unwrap().iter();
    let names: Vec<_> = variants.map(|v| v["name"].as_str().unwrap()).collect();
    for name in [
        "picofarm",
        "path-reuse=1",
        "light-vertices=off",
        "mirror-images=off",
    ] {
        assert!(names.contains(&name), "{name} in {names:?}");
    }
    let rungs = scene["variants"][0]["rungs"].as_array().unwrap();
    assert_eq!(rungs.len(), 2, "{found}");
    let error = |k: usize| rungs[k]["error"]["median"].as_f64().unwrap();
    assert!(
        error(0) > error(1) && error(1) > 0.0,
        "four times the paths, less error: {found}"
    );
    for rung in rungs {
        let claimed = rung["claimed"].as_f64().unwrap();
        let energy = rung["error"]["energy_ratio"].as_f64().unwrap();
        assert!(claimed > 0.0 && (0.5..2.0).contains(&energy), "{found}");
    }
    assert!(scene["truth_noise"].as_f64().unwrap() < error(1), "{found}");
    assert!(scene["stopping"]["rung"]["claimed"].as_f64().unwrap() <= 0.3);
}

#[test]
fn a_stored_render_can_be_the_truth() {
    let scratch = Scratch::new("bench-truth");
    let cli = Cli::new(scratch.path());
    let lab = lab(&scratch);
    let generate = ["scene", "generate", "--kind", "primitive", "--spots", "4"];
    cli.run(&[&generate[..], &["--out", "room.glb"]].concat())
        .ok();
    let size = [
        "--resolution",
        "16",
        "--bins",
        "64",
        "--bin-width-m",
        "0.384",
    ];
    let render = ["scene", "render", "room.glb", "--samples", "256", "--split"];
    let out = ["--seed", "9", "--out", "truth.zarr"];
    cli.run(&[&render[..], &size, &out].concat()).ok();
    let bench = ["render", "room.glb", "--ladder", "4"];
    let truth = ["--error", "50%", "--truth", "truth.zarr"];
    let found = lab.json(&[&bench[..], &size, &truth].concat());
    let scene = &found["scenes"][0];
    assert_eq!(scene["truth"], "truth.zarr");
    let rung = &scene["variants"][0]["rungs"][0];
    assert!(rung["error"]["median"].as_f64().unwrap() > 0.0, "{found}");

    // Results with another gate are not comparable.
    lab.run(&[&bench[..], &truth, &["--resolution", "16"]].concat())
        .fails(3, &["truth.zarr", "gate"]);
    lab.run(&["render", "no-such-room"])
        .fails(3, &["no-such-room", "presets"]);
}

#[test]
fn a_quick_study_of_growth_has_an_exponent_for_each_axis() {
    let scratch = Scratch::new("bench-scaling");
    let lab = lab(&scratch);
    let study = ["render", "primitive", "--scaling", "--quick"];
    let size = ["--resolution", "8", "--error", "60%"];
    let found = lab.json(&[&study[..], &size].concat());
    let axes = found["axes"].as_array().unwrap();
    let names: Vec<_> = axes.iter().map(|a| a["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["triangles", "spots", "bins", "pixels"]);
    for axis in axes {
        assert!(axis["exponent"].is_number(), "{axis}");
        assert!(axis["points"].as_array().unwrap().len() >= 2, "{axis}");
    }
}

#[test]
fn strategies_are_compared_row_by_row() {
    let scratch = Scratch::new("bench-strategies");
    let lab = lab(&scratch);
    let compared = [
        "--error",
        "50%",
        "--strategies",
        "default,path-reuse=1+mirror-images=off",
        "--plot",
        "plot.png",
    ];
    let found = lab.json(&[&TINY[..], &compared].concat());
    let variants = found["scenes"][0]["variants"].as_array().unwrap();
    let names: Vec<_> = variants
        .iter()
        .map(|v| v["name"].as_str().unwrap())
        .collect();
    assert_eq!(names, ["picofarm", "path-reuse=1+mirror-images=off"]);
    let rays = |k: usize| variants[k]["rungs"][1]["rays"].as_u64().unwrap();
    assert_ne!(rays(0), rays(1), "they work in other ways: {found}");
    assert!(scratch.join("plot.png").is_file());
    lab.run(&[&TINY[..], &["--strategies", "default,sharing=1"]].concat())
        .fails(2, &["sharing", "light_vertices"]);
}
