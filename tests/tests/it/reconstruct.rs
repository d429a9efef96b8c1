//! `picofarm reconstruct`: reconstructs one scene file without a farm.

use std::{path::Path, sync::Arc};

use picofarm_tests::{Cli, Scratch};
use serde_json::Value;
use zarrs::{array::Array, filesystem::FilesystemStore};

/// Creates a scratch folder with a small room, `room.glb`.
fn room(name: &str, object: &str, spots: &str) -> (Scratch, Cli) {
    let scratch = Scratch::new(name);
    let cli = Cli::new(scratch.path());
    let make = [
        "scene", "generate", "--kind", "plato", "--object", object, "--spots", spots,
    ];
    cli.run(&[&make[..], &["--resolution", "64", "--out", "room.glb"]].concat())
        .ok();
    (scratch, cli)
}

const TRUTH: [&str; 9] = [
    "reconstruct",
    "room.glb",
    "--spots-from",
    "truth",
    "--resolution",
    "64",
    "--nodes",
    "48",
    "--out",
];

/// Files with contents that depend on scene and arguments only.
const ALWAYS_SAME: [&str; 5] = [
    "mesh.glb",
    "mesh.ply",
    "metrics.json",
    "views.png",
    "density.zarr/density/c/0/0/0",
];

fn metrics(dir: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(dir.join("metrics.json")).unwrap()).unwrap()
}

#[test]
fn a_scene_becomes_a_mesh_a_density_and_its_errors_and_nothing_else() {
    let (scratch, cli) = room("reconstruct", "chair", "16");
    let said = cli.json(&[&TRUTH[..], &["made", "--views", "plato"]].concat());
    let dir = scratch.join("made");
    let mut names: Vec<_> = std::fs::read_dir(&dir)
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    let files = [
        "density.zarr",
        "mesh.glb",
        "mesh.ply",
        "metrics.json",
        "orbit.gif",
        "views.png",
    ];
    assert_eq!(names, files);
    assert!(
        std::fs::read(dir.join("orbit.gif"))
            .unwrap()
            .starts_with(b"GIF89a")
    );
    assert!(
        std::fs::read(dir.join("views.png"))
            .unwrap()
            .starts_with(b"\x89PNG")
    );
    let left: Vec<_> = std::fs::read_dir(scratch.path())
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .filter(|n| n.contains("partial"))
        .collect();
    assert!(left.is_empty(), "{left:?}");

    let kept = metrics(&dir);
    for name in [
        "novel_views",
        "mesh",
        "floaters",
        "evidence",
        "settings",
        "notes",
    ] {
        assert_eq!(kept[name], said[name], "{name}");
    }
    assert!(kept["seconds"].is_null(), "the file has no times: {kept}");
    assert!(said["seconds"]["reconstruction"].as_f64().unwrap() > 0.0);
    assert_eq!(kept["novel_views"]["views"], 139);
    assert_eq!(kept["spots"], 16);
    let l1 = kept["novel_views"]["all"]["l1_m"].as_f64().unwrap();
    assert!(l1 < 0.3, "{l1} m");
    assert!(
        kept["mesh"]["chamfer_m"].as_f64().unwrap() < 0.06,
        "{}",
        kept["mesh"]
    );

    let ply = std::fs::read(dir.join("mesh.ply")).unwrap();
    let end = b"end_header\n";
    let header = ply.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let (vertices, faces) = (
        kept["vertices"].as_u64().unwrap(),
        kept["triangles"].as_u64().unwrap(),
    );
    assert_eq!(ply.len() as u64, header as u64 + 12 * vertices + 13 * faces);

    // The importer reads it, and the renderer accepts it: it has the camera and the beams of the
    // measurement.
    let shown = cli.json(&["scene", "show", "made/mesh.glb"]);
    assert_eq!(shown["triangles"], kept["triangles"], "{shown}");
    assert_eq!(shown["beams"], 16, "{shown}");

    let store = Arc::new(FilesystemStore::new(dir.join("density.zarr")).unwrap());
    let array = Array::open(store, "/density").unwrap();
    let density: Vec<f32> = array.retrieve_array_subset(&array.subset_all()).unwrap();
    assert_eq!(array.shape().iter().max(), Some(&48));
    assert!(density.iter().all(|d| d.is_finite() && *d >= 0.0));
    let group: Value =
        serde_json::from_slice(&std::fs::read(dir.join("density.zarr/zarr.json")).unwrap())
            .unwrap();
    let attributes = &group["attributes"];
    assert!(
        attributes["spacing_m"].as_f64().unwrap() > 0.05,
        "{attributes}"
    );
    assert!(attributes["surface_density_per_m"].as_f64().unwrap() > 1.0);
}

#[test]
fn threads_change_no_byte() {
    let (scratch, cli) = room("reconstruct-threads", "hidden-box", "4");
    for threads in ["1", "3"] {
        cli.run(&[&TRUTH[..], &[threads, "--threads", threads, "--no-planes"]].concat())
            .ok();
    }
    for file in ALWAYS_SAME {
        let read = |dir: &str| std::fs::read(scratch.join(dir).join(file)).unwrap();
        assert!(read("1") == read("3"), "{file}");
    }
}

#[test]
fn captures_are_rendered_and_measured() {
    let (scratch, cli) = room("reconstruct-captures", "armchair", "4");
    let small = [
        "--resolution",
        "48",
        "--nodes",
        "40",
        "--samples",
        "2",
        "--gate-start-m",
        "0",
        "--bins",
        "400",
    ];
    let ended = cli
        .run(&[&["reconstruct", "room.glb", "--out", "made"], &small[..]].concat())
        .ok();
    assert!(ended.stdout.contains("novel views: L1"), "{}", ended.stdout);
    assert!(ended.stderr.contains("capture 1 of 4"), "{}", ended.stderr);
    let kept = metrics(&scratch.join("made"));
    assert_eq!(kept["spots_from"], "captures");
    assert_eq!(kept["left_out"], serde_json::json!([]));
    let l1 = kept["novel_views"]["all"]["l1_m"].as_f64().unwrap();
    assert!(l1 < 1.5, "{l1} m");
}

#[test]
fn what_cannot_be_used_is_refused_by_name_and_nothing_is_written() {
    let (scratch, cli) = room("reconstruct-refused", "empty", "1");
    let to =
        |more: &[&str]| cli.run(&[&["reconstruct", "room.glb", "--out", "made"], more].concat());
    for (more, code, said) in [
        (&["--resolution", "0"][..], 2, "--resolution"),
        (&["--nodes", "8"], 2, "--nodes"),
        (&["--fine", "--nodes", "64"], 2, "--fine"),
        (&["--spots-from", "guesses"], 2, "captures, truth"),
        (&["--spots-from", "predictions"], 3, "needs --models"),
        (
            &["--tof", "depth"],
            3,
            "--tof belongs to --spots-from predictions",
        ),
        // All light arrives after the end of this gate.
        (
            &[
                "--resolution",
                "16",
                "--samples",
                "1",
                "--gate-start-m",
                "0",
                "--bins",
                "20",
            ],
            3,
            "gate",
        ),
    ] {
        let ended = to(more).code(code);
        assert!(ended.stderr.contains(said), "{more:?}: {}", ended.stderr);
        assert!(!scratch.join("made").exists(), "{more:?}");
    }
    let missing = cli
        .run(&["reconstruct", "nothing.glb", "--out", "made"])
        .code(3);
    assert!(missing.stderr.contains("nothing.glb"), "{}", missing.stderr);
    std::fs::create_dir(scratch.join("made")).unwrap();
    std::fs::write(scratch.join("made/mine"), "mine").unwrap();
    let taken = to(&["--spots-from", "truth"]).code(3);
    assert!(taken.stderr.contains("not empty"), "{}", taken.stderr);
}

#[test]
fn one_spot_works_and_what_it_lacks_is_said() {
    let (scratch, cli) = room("reconstruct-one", "chair", "1");
    let ended = cli.run(&[&TRUTH[..], &["made"]].concat()).ok();
    assert!(ended.stdout.contains("note: one spot"), "{}", ended.stdout);
    let notes = metrics(&scratch.join("made"))["notes"].to_string();
    assert!(notes.contains("have no depth"), "{notes}");
}

#[test]
fn networks_make_the_same_files_and_the_same_bytes_for_any_number_of_threads() {
    let (scratch, cli) = room("reconstruct-mlp", "chair", "4");
    let few = [
        "--field", "mlp", "--steps", "16", "--width", "8", "--batch", "32",
    ];
    for threads in ["1", "3"] {
        let ended = cli
            .run(&[&TRUTH[..], &[threads, "--threads", threads], &few].concat())
            .ok();
        assert!(ended.stdout.contains("note: mlp:"), "{}", ended.stdout);
    }
    for file in ALWAYS_SAME {
        let read = |dir: &str| std::fs::read(scratch.join(dir).join(file)).unwrap();
        assert!(read("1") == read("3"), "{file}");
    }
    let kept = metrics(&scratch.join("1"));
    assert_eq!(kept["mlp"]["distance_steps"], 2);
    assert_eq!(kept["mlp"]["shadow_steps"], 14);
    assert_eq!(kept["iterations"], 16);
    assert!(kept["loss"].as_f64().unwrap() > 0.0);
}

#[test]
fn options_of_the_other_field_are_refused() {
    let (scratch, cli) = room("reconstruct-fields", "empty", "1");
    for (more, said) in [
        (&["--steps", "100"][..], "--steps belongs to --field mlp"),
        (&["--width", "64"], "--width belongs to --field mlp"),
        (&["--batch", "64"], "--batch belongs to --field mlp"),
        (
            &["--shadow-loss", "squares"],
            "--shadow-loss belongs to --field mlp",
        ),
        (&["--field", "mlp"], "--field mlp needs --steps"),
        (
            &["--field", "mlp", "--steps", "100", "--no-planes"],
            "--no-planes belongs to --field grid",
        ),
    ] {
        let ended = cli.run(&[&TRUTH[..], &["made"], more].concat()).code(3);
        assert!(ended.stderr.contains(said), "{more:?}: {}", ended.stderr);
        assert!(!scratch.join("made").exists(), "{more:?}");
    }
}

#[test]
fn one_flash_becomes_a_room_with_the_same_bytes_on_any_number_of_threads() {
    let scratch = Scratch::new("reconstruct-flash");
    let cli = Cli::new(scratch.path());
    let make = [
        "scene",
        "generate",
        "--kind",
        "furnished",
        "--assets",
        "parametric",
        "--seed",
        "92001",
        "--out",
        "room.glb",
    ];
    cli.run(&make).ok();
    let flash = |from: &str, threads: &str, out: &str| {
        let args = [
            "reconstruct",
            "room.glb",
            "--spots-from",
            from,
            "--resolution",
            "64",
            "--samples",
            "8",
            "--nodes",
            "64",
            "--threads",
            threads,
            "--out",
            out,
        ];
        cli.json(&args)
    };
    let said = flash("flash", "1", "one");
    let number = |path: &str| said.pointer(path).and_then(Value::as_f64).unwrap();
    assert_eq!(said["spots_from"], "flash");
    assert!(number("/flash/depth/median_m") < 0.02, "{said}");
    assert!(
        number("/flash/masks/iou") > number("/flash/masks/all_lit_iou"),
        "{said}"
    );
    assert!(number("/novel_views/all/l1_m") < 0.5, "{said}");
    flash("flash", "3", "three");
    for name in ALWAYS_SAME {
        let bytes = |out: &str| std::fs::read(scratch.join(out).join(name)).unwrap();
        assert_eq!(bytes("one"), bytes("three"), "{name}");
    }
}
