//! Histograms of subsets of the spots from one pass, in single renders and in data sets; and the
//! estimated cost of a render.

use std::fs;

use picofarm_tests::{Cli, Farm, Job, Scratch, store};

use crate::arrays::array;

const GATE: [&str; 4] = ["--bins", "64", "--bin-width-m", "0.384"];
const FOUR: [usize; 4] = [22, 27, 72, 77];

/// Generates a room with `spots` spots, `room.glb`.
fn room(cli: &Cli, spots: &str) {
    let generate = ["scene", "generate", "--kind", "primitive", "--seed", "3"];
    cli.run(&[&generate[..], &["--spots", spots, "--out", "room.glb"]].concat())
        .ok();
}

/// Returns the sum over some of the planes of `[spot][…]`.
fn sum(planes: &[f32], one: usize, spots: impl Iterator<Item = usize>) -> Vec<f64> {
    let mut all = vec![0.0; one];
    for spot in spots {
        let plane = &planes[spot * one..][..one];
        all.iter_mut()
            .zip(plane)
            .for_each(|(a, h)| *a += f64::from(*h));
    }
    all
}

fn same(what: &str, found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let top = expected.iter().fold(0.0f64, |a, &b| a.max(b));
    assert!(top > 0.0, "{what} is not empty");
    for (f, e) in found.iter().zip(expected) {
        let off = (f64::from(*f) - e).abs();
        assert!(off <= 1e-4 * e + 1e-7 * top, "{what}: {f} is not {e}");
    }
}

#[test]
fn groups_of_a_render_add_up_and_are_those_asked_for() {
    let scratch = Scratch::new("groups");
    let cli = Cli::new(scratch.path());
    room(&cli, "100");
    let render = [
        "scene",
        "render",
        "room.glb",
        "--resolution",
        "16",
        "--samples",
        "4",
    ];
    let groups = ["--groups", "4,25,per-spot", "--group", "left=0,5,7"];
    let out = ["--out", "room.zarr"];
    let report = cli.json(&[&render[..], &GATE, &groups, &out].concat());
    assert_eq!(
        report["subsets"],
        serde_json::json!([
            "transient_4",
            "transient_25",
            "transient_spots",
            "transient_left"
        ])
    );
    let group = scratch.join("room.zarr");
    let (shape, whole) = array(&group, "transient");
    assert_eq!(shape, [1, 16, 16, 64]);
    let (shape, spots) = array(&group, "transient_spots");
    assert_eq!(shape, [1, 100, 16, 16, 64]);
    let of = |spots_of: &mut dyn Iterator<Item = usize>| sum(&spots, whole.len(), spots_of);
    same("transient", &whole, &of(&mut (0..100)));
    let (shape, four) = array(&group, "transient_4");
    assert_eq!(shape, [1, 16, 16, 64]);
    same("transient_4", &four, &of(&mut FOUR.into_iter()));
    let mut grid = (0..25).map(|i| i / 5 * 20 + i % 5 * 2 + 1);
    same(
        "transient_25",
        &array(&group, "transient_25").1,
        &of(&mut grid),
    );
    let left = array(&group, "render/transient_left").1;
    same("transient_left", &left, &of(&mut [0, 5, 7].into_iter()));

    // Without groups, the main histogram is the same.
    cli.run(&[&render[..], &GATE, &["--out", "plain.zarr"]].concat())
        .ok();
    let plain = array(&scratch.join("plain.zarr"), "transient").1;
    assert!(plain == whole, "groups change nothing else");
}

#[test]
fn groups_and_strategies_that_there_are_not_are_refused_with_those_there_are() {
    let scratch = Scratch::new("groups-refused");
    let cli = Cli::new(scratch.path());
    room(&cli, "25");
    for command in ["render", "plan"] {
        let with = |more: &[&str]| {
            let mut args = vec!["scene", command, "room.glb"];
            if command == "render" {
                args.extend(["--out", "out", "--samples", "2"]);
            }
            cli.run(&[&args[..], more].concat())
        };
        with(&["--groups", "4"]).fails(
            3,
            &["--groups 4", "10x10 grid", "this laser has 25", "hint: "],
        );
        with(&["--group", "a=25"]).fails(3, &["--group a", "beam 25", "25, counted from 0"]);
        with(&["--groups", "per-spot", "--group", "spots=1"]).fails(3, &["transient_spots"]);
        with(&["--strategy", "path-reuse=99"]).fails(3, &["strategy.path_reuse"]);
        with(&["--groups", "5"]).fails(2, &["--groups", "4, 25 or per-spot"]);
        with(&["--group", "left"]).fails(2, &["NAME=BEAM"]);
        let unknown = with(&["--strategy", "lobes=off"]);
        unknown.fails(
            2,
            &["lobes", "path_reuse", "light_vertices", "mirror_images"],
        );
        with(&["--strategy", "path-reuse=on"]).fails(2, &["path_reuse", "number"]);
    }
    let huge = [
        "scene", "render", "room.glb", "--out", "out", "--groups", "per-spot",
    ];
    cli.run(&[&huge[..], &["--resolution", "4096", "--bins", "60000"]].concat())
        .fails(
            7,
            &[
                "26 histograms of 4096x4096 pixels x 60000 bins",
                "GiB of memory",
            ],
        );
    assert!(!scratch.join("out").exists(), "nothing is left behind");
}

#[test]
fn a_plan_says_what_a_render_would_do_and_writes_nothing() {
    let scratch = Scratch::new("scene-plan");
    let cli = Cli::new(scratch.path());
    room(&cli, "4");
    let small = ["--resolution", "32", "--samples", "16"];
    let plan = [&["scene", "plan", "room.glb"][..], &GATE, &small].concat();
    let found = cli.json(&plan);
    assert_eq!(
        (&found["samples"], &found["spots"]),
        (&16.into(), &4.into())
    );
    let strategies = found["strategies"].as_array().unwrap();
    assert!(!strategies.is_empty(), "{found}");
    assert!(found["rays"].as_u64().unwrap() > 10_000, "{found}");
    assert!(
        found["memory_bytes"].as_u64().unwrap() >= 32 * 32 * 64 * 4,
        "{found}"
    );
    let error = |plan: &serde_json::Value| plan["error"].as_f64().unwrap();
    assert!((0.001..10.0).contains(&error(&found)), "{found}");
    let text = cli.run(&plan).ok().stdout;
    for part in [
        "32x32 pixels x 64 bins, 4 spots",
        "16 paths a pixel",
        "M rays",
    ] {
        assert!(text.contains(part), "{part:?} in {text}");
    }
    assert!(text.contains(strategies[0].as_str().unwrap()), "{text}");

    // A smaller error takes more samples.
    let goal = |share| {
        let args = [
            "scene",
            "plan",
            "room.glb",
            "--resolution",
            "32",
            "--error",
            share,
        ];
        cli.json(&[&args[..], &GATE].concat())
    };
    let (coarse, fine) = (goal("40%"), goal("2%"));
    assert!(
        error(&fine) <= 0.02 && error(&fine) < error(&coarse),
        "{fine} {coarse}"
    );
    assert!(fine["rays"].as_u64() > coarse["rays"].as_u64());
    let files: Vec<_> = fs::read_dir(scratch.path()).unwrap().flatten().collect();
    let made = files.iter().filter(|f| f.path().is_dir()).count();
    assert_eq!(made, 0, "no folder was made: {files:?}");
}

/// Submits a job over a 10×10 grid with more lines in `[render]`.
fn submit(farm: &Farm, job: &Job, name: &str, render: &str) -> picofarm_tests::Ended {
    let file = format!("{name}.toml");
    let text = job
        .toml()
        .replace("[render]", &format!("[render]\n{render}"));
    fs::write(farm.scratch.join(&file), text).unwrap();
    farm.run(&["job", "submit", &file, "--json"])
}

#[test]
fn a_job_with_subsets_stores_them_beside_the_transient_and_they_add_up() {
    let farm = Farm::start("subsets");
    let job = Job {
        name: "subsets".into(),
        scenes: "kind = \"primitive\"\nspots = 100".into(),
        ..Job::quick(&farm.store(), 2)
    };
    let plain = |text: String| {
        text.replace(
            "dataset = \"rooms\"",
            "dataset = \"rooms\"\nprofile = \"lossless\"",
        )
    };
    let _worker = farm.worker("worker");
    let render = "subsets = [25, 4]\nper_spot = true\nstrategy = { path_reuse = 4 }\n";
    let file = farm.scratch.join("subsets.toml");
    let text = job
        .toml()
        .replace("[render]", &format!("[render]\n{render}"));
    fs::write(&file, plain(text)).unwrap();
    let id = farm.json(&["job", "submit", "subsets.toml"])["job"]
        .as_str()
        .unwrap()
        .to_owned();
    farm.until_done_once(&job, &id);

    let place = job.place();
    let keys = store::objects(&place, 1);
    for key in [
        "transient_4/c/1/0/0/0",
        "transient_25/c/1/0/0/0",
        "transient_spots/c/1/0/0/0/0",
    ] {
        assert!(keys.iter().any(|k| k == key), "{key} in {keys:?}");
    }
    let (shape, whole) = array(&place, "transient");
    assert_eq!(shape, [2, 16, 16, 64]);
    let (shape, spots) = array(&place, "transient_spots");
    assert_eq!(shape, [2, 100, 16, 16, 64]);
    let one = 16 * 16 * 64;
    for scene in 0..2 {
        let planes = &spots[scene * 100 * one..][..100 * one];
        let of = |array: &[f32]| array[scene * one..][..one].to_vec();
        same("transient", &of(&whole), &sum(planes, one, 0..100));
        let four = array(&place, "transient_4").1;
        same(
            "transient_4",
            &of(&four),
            &sum(planes, one, FOUR.into_iter()),
        );
    }
    let info = farm.json(&["dataset", "info", "store/rooms"]);
    assert_eq!(info["spec"]["subsets"], serde_json::json!([4, 25]));
    assert!(info["noise"].as_f64().unwrap() > 0.0, "{info}");
    let text = farm.run(&["dataset", "info", "store/rooms"]).ok().stdout;
    assert!(text.contains("4 of them, 25 of them, each alone"), "{text}");
    assert!(text.contains("Monte Carlo error"), "{text}");
    assert!(info["rays"].as_f64().unwrap() > 1.0, "{info}");
    assert!(text.contains("million rays a scene"), "{text}");
    farm.run(&["dataset", "picture", "store/rooms", "--out", "pictures"])
        .ok();

    // The same data set with other settings is rejected by name.
    for (name, render, part) in [
        (
            "fewer",
            "subsets = [4]\nper_spot = true\nstrategy = { path_reuse = 4 }\n",
            "render.subsets is [4] and was [4,25]",
        ),
        (
            "none",
            "subsets = [4, 25]\nstrategy = { path_reuse = 4 }\n",
            "render.per_spot is unset and was true",
        ),
        (
            "other",
            &render.replace("path_reuse = 4", "path_reuse = 2"),
            "render.strategy.path_reuse is 2 and was 4",
        ),
    ] {
        let text = job
            .toml()
            .replace("[render]", &format!("[render]\n{render}"));
        fs::write(farm.scratch.join("other.toml"), plain(text)).unwrap();
        let ended = farm.run(&["job", "submit", "other.toml"]);
        println!("{name}");
        ended.fails(3, &["output.dataset", part]);
    }
}

#[test]
fn a_job_with_unknown_subsets_or_strategies_is_refused_by_field() {
    let farm = Farm::start("subsets-refused");
    let job = Job::quick(&farm.store(), 1);
    let refused = |render: &str, parts: &[&str]| {
        submit(&farm, &job, "bad", render).fails(3, parts);
    };
    refused("subsets = [4]", &["render.subsets", "scenes.spots = 4"]);
    refused("subsets = [7]", &["render.subsets", "7"]);
    refused(
        "strategy = { lobes = false }",
        &["render.strategy", "lobes", "mirror_images"],
    );
    refused(
        "strategy = { path_reuse = true }",
        &["render.strategy", "path_reuse", "number"],
    );
    assert_eq!(farm.json(&["job", "list"])["jobs"], serde_json::json!([]));
}
