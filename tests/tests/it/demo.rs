//! `picofarm demo` makes its scenes once, can be interrupted, and can be extended.

use std::{fs, path::Path};

use picofarm_tests::{Cli, Ended, Process, Scratch, Signal, store, wait::until};

fn args<'a>(scenes: &'a str, samples: &'a str) -> Vec<&'a str> {
    let small = [
        "--resolution",
        "16",
        "--spots",
        "4",
        "--assets",
        "parametric",
    ];
    [
        &[
            "demo",
            "--dir",
            "demo",
            "--scenes",
            scenes,
            "--samples",
            samples,
        ][..],
        &small,
    ]
    .concat()
}

fn demo(cli: &Cli, scenes: &str, samples: &str) -> Ended {
    cli.run(&[&args(scenes, samples)[..], &["--json"]].concat())
        .ok()
}

fn begins_with(path: &Path, magic: &[u8]) {
    let bytes = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    assert!(
        bytes.starts_with(magic) && bytes.len() > 100,
        "{}",
        path.display()
    );
}

#[test]
fn the_demo_makes_a_data_set_and_pictures_and_a_second_run_renders_nothing() {
    let scratch = Scratch::new("demo");
    let cli = Cli::new(scratch.path());
    let first = demo(&cli, "2", "4").json();
    assert_eq!(first["scenes"], 2);
    let dir = scratch.join("demo");
    begins_with(&dir.join("contact-sheet.png"), b"\x89PNG\r\n\x1a\n");
    begins_with(&dir.join("light-in-flight.gif"), b"GIF89a");
    assert!(first["room"]["triangles"].as_u64().unwrap() > 0, "{first}");
    begins_with(&dir.join("room-3d/mesh.glb"), b"glTF");
    begins_with(&dir.join("room-3d/views.png"), b"\x89PNG\r\n\x1a\n");
    let room = store::hashes(&dir.join("room-3d"));
    let place = dir.join("store/rooms");
    assert_eq!(first["dataset"], place.display().to_string());
    assert_eq!(store::finished(&place), [0, 1]);
    let (hashes, times) = (store::hashes(&place), store::times(&place));

    let second = demo(&cli, "2", "4").json();
    assert_eq!(second["job"], first["job"]);
    assert_eq!(store::hashes(&dir.join("room-3d")), room);
    assert_eq!(store::times(&place), times, "nothing is written again");

    // With one more scene, the finished ones do not change.
    let grown = demo(&cli, "3", "4").json();
    assert_eq!(
        (&grown["scenes"], &grown["reused"]),
        (&3.into(), &2.into()),
        "{grown}"
    );
    assert_eq!(store::finished(&place), [0, 1, 2]);
    let (new_hashes, new_times) = (store::hashes(&place), store::times(&place));
    for scene in [0, 1] {
        for key in store::objects(&place, scene) {
            assert_eq!(new_hashes[&key], hashes[&key], "{key}");
            assert_eq!(new_times[&key], times[&key], "{key} was written again");
        }
    }
}

#[test]
fn the_demo_goes_on_to_rooms_in_3d_and_a_second_run_makes_nothing_again() {
    let scratch = Scratch::new("demo-3d");
    let cli = Cli::new(scratch.path());
    let small = [
        "demo",
        "--dir",
        "demo",
        "--scenes",
        "2",
        "--samples",
        "2",
        "--resolution",
        "48",
        "--spots",
        "4",
        "--assets",
        "parametric",
    ];
    let said = cli.run(&[&small[..], &["--reconstruct"]].concat()).ok();
    assert!(said.stderr.contains("ground truth"), "{}", said.stderr);
    let dir = scratch.join("demo");
    let place = dir.join("store/rooms-3d");
    for shown in ["mesh.glb", "reconstructions.png", "rooms-3d"] {
        assert!(said.stdout.contains(shown), "{shown}: {}", said.stdout);
    }
    begins_with(&dir.join("reconstructions.png"), b"\x89PNG\r\n\x1a\n");
    for scene in ["0", "1"] {
        let files = place.join("scenes").join(scene);
        begins_with(&files.join("mesh.glb"), b"glTF");
        begins_with(&files.join("views.png"), b"\x89PNG");
    }
    let times = store::times(&place);
    let again = [&small[..], &["--reconstruct", "--json"]].concat();
    let second = cli.run(&again).ok().json();
    assert_eq!(second["reconstructions"]["scenes"], 2, "{second}");
    assert_eq!(store::times(&place), times, "nothing is written again");
    // The rooms alone are another job, and already exist.
    let rooms = cli.run(&[&small[..], &["--json"]].concat()).ok().json();
    assert_eq!(rooms["reused"], 2, "{rooms}");
    assert!(rooms["reconstructions"].is_null(), "{rooms}");
}

#[test]
fn an_interrupted_demo_exits_130_and_goes_on_where_it_stopped() {
    let scratch = Scratch::new("demo-interrupted");
    let cli = Cli::new(scratch.path());
    let place = scratch.join("demo/store/rooms");
    let mut running: Process = cli.start("demo", &args("6", "256"));
    let before = until("a finished scene", || {
        let finished = store::finished(&place);
        (!finished.is_empty()).then_some(finished)
    });
    running.signal(Signal::Interrupt);
    running.end().fails(130, &["interrupted", "hint:"]);
    let kept = store::finished(&place);
    assert!(before.iter().all(|scene| kept.contains(scene)));
    assert!(kept.len() < 6, "interrupted too late to show anything");
    let (hashes, times) = (store::hashes(&place), store::times(&place));

    demo(&cli, "6", "256");
    assert_eq!(store::finished(&place), (0..6).collect::<Vec<_>>());
    let (new_hashes, new_times) = (store::hashes(&place), store::times(&place));
    for scene in kept {
        for key in store::objects(&place, scene) {
            assert_eq!(new_hashes[&key], hashes[&key], "{key}");
            assert_eq!(new_times[&key], times[&key], "{key} was written again");
        }
    }
    cli.run(&["dataset", "verify", &place.display().to_string()])
        .ok();
}
