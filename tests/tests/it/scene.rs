//! Single scenes without a farm: generate, show, render, and the resulting arrays.

use std::{path::Path, sync::Arc};

use picofarm_tests::{Cli, Scratch, store};
use zarrs::{array::Array, filesystem::FilesystemStore};

use crate::arrays::array;

const GATE: [&str; 4] = ["--bins", "64", "--bin-width-m", "0.384"];

#[test]
fn a_generated_scene_is_the_same_file_each_time_and_shows_what_it_holds() {
    let scratch = Scratch::new("generate");
    let cli = Cli::new(scratch.path());
    for kind in ["primitive", "furnished"] {
        let generate = [
            "scene",
            "generate",
            "--kind",
            kind,
            "--seed",
            "3",
            "--assets",
            "parametric",
        ];
        let small = ["--spots", "4", "--resolution", "16"];
        for out in ["a.glb", "b.glb"] {
            cli.run(&[&generate[..], &small, &["--out", out]].concat())
                .ok();
        }
        let read = |name| std::fs::read(scratch.join(name)).unwrap();
        assert!(
            read("a.glb") == read("b.glb"),
            "{kind}: the seed decides everything"
        );
        let facts = cli.json(&["scene", "show", "a.glb"]);
        assert_eq!(facts["beams"], 4);
        assert!(facts["objects"].as_u64().unwrap() > 2, "{facts}");
        assert!(
            facts["labels"].as_object().unwrap().contains_key("floor"),
            "{facts}"
        );
        assert!(
            cli.run(&["scene", "show", "a.glb"])
                .ok()
                .stdout
                .contains("triangles")
        );
    }
}

#[test]
fn an_exported_scene_is_read_back_in_every_format() {
    let scratch = Scratch::new("export");
    let cli = Cli::new(scratch.path());
    let generate = ["scene", "generate", "--kind", "primitive", "--spots", "4"];
    cli.run(&[&generate[..], &["--out", "room.glb"]].concat())
        .ok();
    let triangles = cli.json(&["scene", "show", "room.glb"])["triangles"].clone();
    for (out, format, file) in [
        ("copy.glb", None, "copy.glb"),
        ("there", Some("mitsuba"), "there/scene.xml"),
    ] {
        let mut export = vec!["scene", "export", "room.glb", "--out", out];
        export.extend(format.into_iter().flat_map(|f| ["--format", f]));
        cli.run(&export).ok();
        let facts = cli.json(&["scene", "show", file]);
        assert_eq!(
            (&facts["triangles"], &facts["beams"]),
            (&triangles, &4.into())
        );
        assert_eq!(facts["mirror_materials"], 1);
    }
    let read = |name| std::fs::read(scratch.join(name)).unwrap();
    assert!(read("room.glb") == read("copy.glb"), "nothing is lost");

    cli.run(&["scene", "export", "room.glb", "--out", "room.ply"])
        .ok();
    cli.run(&["scene", "export", "room.ply", "--out", "mesh.glb"])
        .ok();
    let facts = cli.json(&["scene", "show", "mesh.glb"]);
    assert_eq!(
        (&facts["triangles"], &facts["beams"]),
        (&triangles, &25.into())
    );
    let nameless = cli.run(&["scene", "export", "room.glb", "--out", "room.usd"]);
    nameless.fails(3, &["room.usd", "--format"]);
}

#[test]
fn a_lone_mesh_is_rendered_without_any_option_to_a_picture() {
    let scratch = Scratch::new("lone-mesh");
    let cli = Cli::new(scratch.path());
    // A corner of two walls, in millimetres.
    let obj = "v 0 0 0\nv 90 0 0\nv 90 70 0\nv 0 70 0\nv 0 0 80\nv 0 70 80\nf 1 2 3 4\nf 1 4 6 5\n";
    std::fs::write(scratch.join("corner.obj"), obj).unwrap();
    let render = ["scene", "render", "corner.obj", "--out", "corner.zarr"];
    let size = ["--resolution", "24x16", "--samples", "4"];
    let text = cli.run(&[&render[..], &size[..]].concat()).ok().stdout;
    for said in [
        "camera: in front",
        "laser: ",
        "unit: mm",
        "gate: ",
        "--look-from",
        "--spots",
        "--unit",
        "--gate",
        "preview.png",
    ] {
        assert!(text.contains(said), "{said}: {text}");
    }
    assert!(!text.contains("hit nothing"), "{text}");
    let png = std::fs::read(scratch.join("corner.zarr/preview.png")).unwrap();
    assert!(png.starts_with(b"\x89PNG"));
    // Stated choices are used and not printed.
    let stated = [
        "scene",
        "render",
        "corner.obj",
        "--out",
        "stated.zarr",
        "--look-from",
        "0.04,0.04,0.2",
        "--look-at",
        "0.04,0.03,0",
        "--spots",
        "25",
        "--unit",
        "mm",
        "--gate",
        "0.05,0.8",
        "--resolution",
        "16",
        "--samples",
        "4",
    ];
    let text = cli.run(&stated).ok().stdout;
    for said in ["camera: ", "laser: ", "unit: ", "gate: "] {
        assert!(
            !text.lines().any(|line| line.starts_with(said)),
            "{said}: {text}"
        );
    }
    let wrong = [
        "scene",
        "render",
        "corner.obj",
        "--out",
        "w",
        "--look-from",
        "1,2",
    ];
    cli.run(&wrong).fails(2, &["--look-from", "three numbers"]);
}

#[test]
fn the_parts_of_a_split_render_add_up_to_the_whole() {
    let scratch = Scratch::new("split");
    let cli = Cli::new(scratch.path());
    let generate = [
        "scene",
        "generate",
        "--kind",
        "primitive",
        "--seed",
        "3",
        "--spots",
        "4",
    ];
    cli.run(&[&generate[..], &["--out", "room.glb"]].concat())
        .ok();
    let render = [
        "scene",
        "render",
        "room.glb",
        "--resolution",
        "16",
        "--samples",
        "16",
        "--split",
    ];
    let render = [&render[..], &GATE].concat();
    let report = cli.json(&[&render[..], &["--out", "room.zarr"]].concat());
    assert!(report["rays"].as_u64().unwrap() > 0, "{report}");
    let group = scratch.join("room.zarr");
    let get = |name: &str| array(&group, name);
    let (shape, whole) = get("transient");
    assert_eq!(shape, [1, 16, 16, 64]);
    let (two, multi) = (get("render/two").1, get("render/multi").1);
    for name in ["render/two_se", "render/multi_se"] {
        let (shape, error) = get(name);
        assert_eq!(shape, [16, 16, 64]);
        assert!(error.iter().all(|e| e.is_finite() && *e >= 0.0), "{name}");
    }
    assert_eq!(get("depth").0, [1, 16, 16]);

    // The folder is a data set of one scene, with all its ground truth.
    let info = cli.json(&["dataset", "info", "room.zarr"]);
    assert_eq!(
        (&info["scenes"], &info["bytes"].is_u64()),
        (&1.into(), &true)
    );
    cli.run(&["dataset", "verify", "room.zarr", "--complete"])
        .ok();
    let export = ["dataset", "export", "--format", "webdataset"];
    cli.run(&[&export[..], &["room.zarr", "exported"]].concat())
        .ok();
    for (name, values) in [("normal", 3), ("label", 1), ("instance", 1), ("rgb", 3)] {
        let store = Arc::new(FilesystemStore::new(&group).unwrap());
        let array = Array::open(store, &format!("/{name}")).unwrap();
        assert_eq!(
            array.shape().iter().product::<u64>(),
            256 * values,
            "{name}"
        );
    }
    // A damaged ground truth is found.
    let depth = group.join("depth/c/0/0/0");
    let whole_depth = std::fs::read(&depth).unwrap();
    let mut flipped = whole_depth.clone();
    flipped[20] ^= 1;
    std::fs::write(&depth, flipped).unwrap();
    cli.run(&["dataset", "verify", "room.zarr"])
        .fails(6, &["depth/c/0/0/0"]);
    std::fs::write(&depth, whole_depth).unwrap();

    // The remainder is the one-bounce light: never negative, and present only where a spot is seen.
    let sum = |a: &[f32]| a.iter().map(|&v| f64::from(v)).sum::<f64>();
    assert!(sum(&two) > 0.0 && sum(&multi) > 0.0);
    let mut spots = 0;
    for (pixel, whole) in whole.chunks_exact(64).enumerate() {
        let range = pixel * 64..(pixel + 1) * 64;
        let parts = two[range.clone()].iter().zip(&multi[range]);
        let rest: Vec<f32> = whole
            .iter()
            .zip(parts)
            .map(|(w, (t, m))| w - t - m)
            .collect();
        let slack = 1e-5 * whole.iter().fold(0.0f32, |a, &b| a.max(b));
        assert!(
            rest.iter().all(|r| *r >= -slack),
            "pixel {pixel}: the parts exceed the whole"
        );
        spots += usize::from(rest.iter().any(|r| *r > slack));
    }
    assert!(
        (1..=4).contains(&spots),
        "{spots} pixels with one-bounce light from 4 spots"
    );

    // The same seed gives the same bits, also with another number of threads. An existing folder is
    // rejected.
    cli.run(&[&render[..], &["--out", "again.zarr", "--threads", "1"]].concat())
        .ok();
    assert_eq!(
        store::hashes(&scratch.join("again.zarr")),
        store::hashes(&group)
    );
    cli.run(&[&render[..], &["--out", "room.zarr"]].concat())
        .fails(3, &["room.zarr", "not empty"]);
}

#[test]
fn an_interrupted_render_exits_130_and_leaves_nothing() {
    let scratch = Scratch::new("render-interrupted");
    let cli = Cli::new(scratch.path());
    cli.run(&[
        "scene",
        "generate",
        "--kind",
        "primitive",
        "--out",
        "room.glb",
    ])
    .ok();
    let render = [
        "scene",
        "render",
        "room.glb",
        "--samples",
        "4096",
        "--resolution",
        "64",
        "--out",
        "room.zarr",
    ];
    let mut running = cli.start("render", &render);
    picofarm_tests::wait::until("progress", || running.stderr().contains('%').then_some(()));
    running.signal(picofarm_tests::Signal::Interrupt);
    running
        .end()
        .fails(130, &["interrupted", "nothing was written"]);
    assert!(!scratch.join("room.zarr").exists());
}

#[test]
fn a_reference_scene_renders_with_the_same_depth_as_its_walls() {
    let file = Path::new(&picofarm_tests::package())
        .join("../../shared/reference/transients/room-diffuse-1.json");
    if !file.is_file() {
        eprintln!("skipped: there is no reference scene at {}", file.display());
        return;
    }
    let scratch = Scratch::new("reference");
    let cli = Cli::new(scratch.path());
    let scene = file.display().to_string();
    let facts = cli.json(&["scene", "show", &scene]);
    assert_eq!(facts["name"], "room-diffuse-1");
    let render = [
        "scene",
        "render",
        &scene,
        "--resolution",
        "16",
        "--samples",
        "4",
        "--out",
        "room.zarr",
    ];
    cli.run(&[&render[..], &GATE].concat()).ok();
    let (_, depth) = array(&scratch.join("room.zarr"), "depth");
    assert!(
        depth.iter().all(|d| (0.3..10.0).contains(d)),
        "a closed room"
    );
    let (_, transient) = array(&scratch.join("room.zarr"), "transient");
    assert!(transient.iter().all(|h| h.is_finite() && *h >= 0.0));
    let lit = transient
        .chunks_exact(64)
        .filter(|h| h.iter().any(|v| *v > 0.0))
        .count();
    assert!(lit > 200, "light reaches nearly every pixel, {lit} of 256");
}
