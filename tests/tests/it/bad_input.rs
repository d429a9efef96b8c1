//! Invalid input: the exit code tells the kind of error, the message names the cause, and nothing
//! is lost.

use std::fs;

use picofarm_tests::{Cli, Farm, Job, Scratch, shapes::Parts, store};

/// Generates a scene for corruption, `room.glb`.
fn room(cli: &Cli) {
    let args = [
        "scene",
        "generate",
        "--kind",
        "primitive",
        "--seed",
        "5",
        "--spots",
        "4",
    ];
    cli.run(&[&args[..], &["--resolution", "16", "--out", "room.glb"]].concat())
        .ok();
}

#[test]
fn a_job_file_with_an_unknown_field_is_refused_with_file_line_and_field() {
    let farm = Farm::start("unknown-field");
    let file = farm.scratch.join("job.toml");
    let text = Job::quick(&farm.store(), 1).toml();
    for (good, bad) in [
        ("resolution = ", "resolutoin = "),
        ("spots = ", "spotts = "),
        ("[limits]", "[limitz]"),
        ("dataset = ", "data_set = "),
        ("max_crashes = ", "max_crash = "),
    ] {
        fs::write(&file, text.replace(good, bad)).unwrap();
        let name = bad.trim_matches(|c: char| !c.is_ascii_alphabetic());
        farm.run(&["job", "submit", "job.toml"])
            .fails(3, &["job.toml", name, "hint: `picofarm job init`"]);
    }
    assert_eq!(farm.json(&["job", "list"])["jobs"], serde_json::json!([]));
}

#[test]
fn a_negative_gate_is_refused_by_job_and_by_scene_render() {
    let farm = Farm::start("negative-gate");
    let job = Job {
        gate_start_m: -0.5,
        ..Job::quick(&farm.store(), 1)
    };
    job.write(&farm.scratch.join("job.toml"));
    let ended = farm.run(&["job", "submit", "job.toml", "--json"]);
    let error = ended.fails(3, &[]).error();
    let message = error["message"].as_str().unwrap();
    assert!(message.contains("render.gate_start_m: -0.5"), "{message}");
    assert_eq!(error["code"], 3);

    room(&farm.cli());
    let args = [
        "scene",
        "render",
        "room.glb",
        "--out",
        "out",
        "--resolution",
        "8",
        "--samples",
        "2",
    ];
    farm.run(&[&args[..], &["--gate-start-m=-0.5"]].concat())
        .fails(3, &["--gate-start-m", "-0.5", "0..=10000"]);
    assert!(!farm.scratch.join("out").exists(), "nothing is left behind");
}

#[test]
fn a_scene_with_a_vertex_that_is_not_a_number_is_named_and_renders_nothing() {
    let scratch = Scratch::new("nan-vertex");
    let cli = Cli::new(scratch.path());
    room(&cli);
    let mut parts = Parts::of(&scratch.join("room.glb"));
    parts.write(scratch.path(), "whole");
    cli.run(&["scene", "show", "whole.gltf"]).ok();
    parts.spoil_vertex();
    parts.write(scratch.path(), "spoilt");
    for args in [
        &["scene", "show", "spoilt.gltf"][..],
        &[
            "scene",
            "render",
            "spoilt.gltf",
            "--out",
            "out",
            "--samples",
            "2",
        ],
    ] {
        cli.run(args)
            .fails(3, &["spoilt.gltf", "positions", "finite"]);
    }
    assert!(!scratch.join("out").exists());
}

#[test]
fn a_scene_without_its_mesh_file_dies_alone_and_the_message_names_the_file() {
    let farm = Farm::start("missing-mesh");
    room(&farm.cli());
    let parts = Parts::of(&farm.scratch.join("room.glb"));
    parts.write(farm.scratch.path(), "torn");
    let files = [
        farm.scratch.join("torn.gltf"),
        farm.scratch.join("room.glb"),
    ];
    let job = Job {
        max_failures: 2,
        ..Job::files(&farm.store(), &[&files[0], &files[1]])
    };
    let mesh = farm.scratch.join("torn.bin");
    fs::remove_file(&mesh).unwrap();
    farm.run(&["scene", "show", "torn.gltf"])
        .fails(3, &["torn.bin"]);
    let file = farm.scratch.join("early.toml");
    job.write(&file);
    farm.run(&["job", "submit", "early.toml"])
        .fails(3, &["scenes.files[0]", "torn.bin"]);

    // Exists at submission, but is deleted before the worker reads it.
    parts.write(farm.scratch.path(), "torn");
    let id = farm.submit(&job);
    fs::remove_file(&mesh).unwrap();
    let _worker = farm.worker("worker");
    farm.run(&["job", "wait", &id])
        .fails(5, &["1 of 2 tasks are dead", "picofarm job logs", "retry"]);
    let status = farm.status(&id);
    assert_eq!(
        (&status["tasks"]["done"], &status["tasks"]["dead"]),
        (&1.into(), &1.into())
    );
    assert_eq!(store::finished(&job.place()), [1]);
    let failures = [farm.events_of(&id, "failed"), farm.events_of(&id, "dead")].concat();
    assert!(!failures.is_empty());
    for event in failures {
        let message = event["message"].as_str().unwrap();
        assert!(
            event["task"] == 0 && message.contains("torn.bin"),
            "{event}"
        );
    }
}

#[test]
fn a_file_that_is_no_scene_and_one_that_is_not_there_are_told_apart() {
    let scratch = Scratch::new("no-scene");
    let cli = Cli::new(scratch.path());
    fs::write(scratch.join("notes.json"), "{\"hello\": 1}").unwrap();
    cli.run(&["scene", "show", "notes.json"])
        .fails(3, &["notes.json", "expected"]);
    cli.run(&["scene", "show", "absent.glb"])
        .fails(3, &["absent.glb", "check that the file exists"]);
    cli.run(&["scene", "show"]).fails(2, &["Usage"]);
}

#[test]
fn a_taken_port_and_a_taken_catalog_are_refused_and_the_owner_goes_on() {
    let farm = Farm::start("taken");
    let address = farm.url().trim_start_matches("http://");
    let coordinator = ["coordinator", "--allow-insecure", "--catalog"];
    let other = [&coordinator[..], &["other.sqlite", "--listen", address]].concat();
    farm.run(&other)
        .fails(7, &[address, "in use", "another port"]);
    let same = [
        &coordinator[..],
        &["catalog.sqlite", "--listen", "127.0.0.1:0"],
    ]
    .concat();
    farm.run(&same)
        .fails(7, &["catalog.sqlite", "held by another coordinator"]);

    let job = Job::quick(&farm.store(), 1);
    let id = farm.submit(&job);
    let _worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
}

#[test]
fn listening_without_authentication_is_refused() {
    let scratch = Scratch::new("beyond-loopback");
    let cli = Cli::new(scratch.path());
    cli.run(&["coordinator", "--listen", "0.0.0.0:0"])
        .fails(3, &["0.0.0.0:0", "--tokens", "--allow-insecure"]);
    cli.run(&["coordinator", "--listen", "127.0.0.1:0"])
        .fails(3, &["127.0.0.1:0", "--tokens", "--allow-insecure"]);
    cli.run(&["up", "--listen", "0.0.0.0:0"])
        .fails(3, &["0.0.0.0:0", "--tokens", "--allow-insecure"]);
}

#[test]
fn a_coordinator_that_does_not_answer_is_exit_code_4_with_a_hint() {
    let scratch = Scratch::new("unreachable");
    let cli = Cli::new(scratch.path());
    let nobody = ["--coordinator", "http://127.0.0.1:1"];
    cli.run(&[&["job", "list"][..], &nobody].concat()).fails(
        4,
        &[
            "no coordinator answers at http://127.0.0.1:1",
            "hint: ",
            "picofarm up",
        ],
    );
    cli.run(&["job", "list", "--coordinator", "not a url"])
        .fails(3, &["not a url"]);
}

#[test]
fn an_unknown_job_is_named() {
    let farm = Farm::start("unknown-job");
    let unknown = "01234567-89ab-7def-8123-456789abcdef";
    for command in ["status", "watch", "wait", "cancel", "retry", "logs"] {
        for id in [unknown, "nosuch"] {
            farm.run(&["job", command, id]).fails(3, &[id]);
        }
    }
}
