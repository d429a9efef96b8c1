//! One flash taken apart by `picofarm demultiplex`: output files, printed text, and refused inputs.

use picofarm_tests::{Cli, Scratch};

use crate::arrays::array;

const SIDE: u64 = 48;

fn rendered(cli: &Cli) {
    let room = [
        "--kind",
        "furnished",
        "--assets",
        "parametric",
        "--seed",
        "92001",
    ];
    cli.run(&[&["scene", "generate", "--out", "room.glb"][..], &room].concat())
        .ok();
    let size = ["--resolution", "48", "--samples", "8"];
    cli.run(
        &[
            &["scene", "render", "room.glb", "--out", "render"][..],
            &size,
        ]
        .concat(),
    )
    .ok();
}

#[test]
fn a_rendered_flash_comes_apart_the_same_on_any_number_of_threads() {
    let scratch = Scratch::new("demultiplex");
    let cli = Cli::new(scratch.path());
    rendered(&cli);
    let apart = |threads: &str, out: &str| {
        cli.json(&["demultiplex", "render", "--out", out, "--threads", threads])
    };
    let said = apart("1", "one");
    let number = |path: &str| said.pointer(path).and_then(|x| x.as_f64()).unwrap();
    assert!(number("/depth/median_m") < 0.02, "{said}");
    assert!(
        number("/masks/iou") > number("/masks/all_lit_iou"),
        "{said}"
    );
    let one = scratch.join("one");
    let (shape, depth) = array(&one, "depth");
    assert_eq!(shape, [SIDE, SIDE]);
    assert!(depth.iter().all(|z| *z > 0.0 && z.is_finite()));
    let (shape, lit) = array(&one, "lit");
    assert_eq!(shape, [25, SIDE, SIDE]);
    assert!(lit.iter().all(|p| (0.0..=1.0).contains(p)));
    assert!(one.join("picture.png").is_file());
    apart("2", "two");
    for name in ["depth", "lit", "ground", "albedo", "confidence"] {
        assert!(
            array(&one, name).1 == array(&scratch.join("two"), name).1,
            "{name}"
        );
    }
}

#[test]
fn spots_are_found_by_their_returns_and_a_sensors_counts_will_do() {
    let scratch = Scratch::new("demultiplex-counts");
    let cli = Cli::new(scratch.path());
    rendered(&cli);
    let returns = ["--places", "returns"];
    let said = cli.json(&[&["demultiplex", "render", "--out", "found"][..], &returns].concat());
    let median = said["depth"]["median_m"].as_f64().unwrap();
    assert!(median < 0.04, "{said}");
    let photons = ["--peak-photons", "400", "--out", "counts"];
    cli.run(&[&["scene", "sense", "render"][..], &photons].concat())
        .ok();
    let text = cli
        .run(&["demultiplex", "counts", "--out", "seen"])
        .ok()
        .stdout;
    assert!(text.contains("masks of 25 spots"), "{text}");
    // A sensor's counts come without a truth to compare with.
    assert!(!text.contains("MAE"), "{text}");
}

#[test]
fn separate_captures_give_depth_and_masks_by_the_published_methods() {
    let scratch = Scratch::new("demultiplex-separate");
    let cli = Cli::new(scratch.path());
    let room = ["--kind", "plato", "--object", "hidden-box", "--spots", "4"];
    cli.run(&[&["scene", "generate", "--out", "room.glb"][..], &room].concat())
        .ok();
    let size = ["--resolution", "32", "--samples", "8"];
    let spots = ["--groups", "per-spot"];
    let render = ["scene", "render", "room.glb", "--out"];
    cli.run(&[&render[..], &["render"], &size, &spots].concat())
        .ok();
    cli.run(&[&render[..], &["sum"], &size].concat()).ok();
    let narrow = ["--groups", "per-spot", "--bins", "2000"];
    let width = ["--bin-width-m", "0.0096"];
    cli.run(&[&render[..], &["narrow"], &size, &narrow, &width].concat())
        .ok();
    for (method, source) in [("matched-filter", "render"), ("likelihood", "narrow")] {
        let demultiplex = ["demultiplex", source, "--method", method, "--out"];
        let said = cli.json(&[&demultiplex[..], &[method]].concat());
        // The likelihood ratio was made for dark laboratories; a white room has wide returns.
        let limit = if method == "likelihood" { 0.2 } else { 0.05 };
        let median = said["depth"]["median_m"].as_f64().unwrap();
        assert!(median < limit, "{method}: {said}");
        let (shape, _) = array(&scratch.join(method), "lit");
        assert_eq!(shape, [4, 32, 32]);
        // They find no mirrors, and claim none.
        assert!(!scratch.join(method).join("mirror").exists());
        cli.run(&["demultiplex", "sum", "--method", method, "--out", "none"])
            .fails(
                3,
                &["sum", "no histogram of each spot", "--groups per-spot"],
            );
    }
    cli.run(&[
        "demultiplex",
        "render",
        "--method",
        "likelihood",
        "--out",
        "none",
    ])
    .fails(3, &["bins", "0.0384 m wide", "use matched-filter"]);
    let useless = ["--method", "likelihood", "--shadows", "learned"];
    cli.run(&[&["demultiplex", "render", "--out", "none"][..], &useless].concat())
        .fails(3, &["--shadows is for --method physics"]);
}

#[test]
fn what_is_no_flash_is_refused_by_name() {
    let scratch = Scratch::new("demultiplex-refused");
    let cli = Cli::new(scratch.path());
    rendered(&cli);
    let refused = |render: &str, out: &str, parts: &[&str]| {
        cli.run(&["demultiplex", render, "--out", out])
            .fails(3, parts);
    };
    refused("absent", "a", &["absent", "scene render"]);
    cli.run(&["demultiplex", "render", "--out", "done"]).ok();
    refused("done", "b", &["done/zarr.json", "attributes.spots"]);
    refused("render", "done", &["not empty"]);
}
