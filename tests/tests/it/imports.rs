//! Data sets exported in the paper's layout and imported again, by command and as a stage of a job,
//! and scenes written as files for other programs.

use std::{fs, path::PathBuf};

use picofarm_tests::{Cli, Farm, store, wait::until};
use serde_json::Value;

const SCENES: u64 = 4;

/// Renders a data set and exports it in the paper's layout. Returns the folder.
fn exported(farm: &Farm, cli: &Cli) -> PathBuf {
    let store = farm.store();
    submit(
        farm,
        cli,
        &format!(
            r#"name = "source"
[scenes]
kind = "primitive"
count = {SCENES}
seed = 5
spots = 4
[render]
resolution = 32
samples = 4
bin_width_m = 0.0384
bins = 637
[output]
store = "{}"
dataset = "source"
"#,
            store.display()
        ),
    );
    let release = farm.scratch.join("release");
    let source = store.join("source");
    let args = [
        "dataset",
        "export",
        path(&source),
        path(&release),
        "--format",
        "sb3d",
    ];
    cli.run(&args).ok();
    release
}

fn path(path: &std::path::Path) -> &str {
    path.to_str().expect("plain")
}

/// Runs a job to its end.
fn submit(farm: &Farm, cli: &Cli, text: &str) -> Value {
    let file = farm.scratch.join("job.toml");
    fs::write(&file, text).expect("the folder is there");
    let job = cli.json(&["job", "submit", path(&file)])["job"].clone();
    let job = job.as_str().expect("it has an id");
    let status = until("the job to end", || {
        let status = cli.json(&["job", "status", job]);
        (status["state"] != "active").then_some(status)
    });
    assert_eq!(status["state"], "done", "{status}");
    status
}

#[test]
fn what_is_exported_in_the_papers_layout_comes_back_by_command_and_as_a_stage_with_the_same_bytes()
{
    let farm = Farm::start("imports");
    let cli = farm.cli();
    let worker = farm.worker("importer");
    let release = exported(&farm, &cli);

    let target = farm.scratch.join("by-command");
    let import = ["dataset", "import", path(&release), path(&target)];
    let done = cli.json(&import);
    assert_eq!(
        (&done["imported"], &done["found"]),
        (&SCENES.into(), &0.into())
    );
    assert_eq!(done["format"], "sb3d");
    cli.run(&["dataset", "verify", path(&target)]).ok();
    let again = cli.json(&import);
    assert_eq!(
        (&again["imported"], &again["found"]),
        (&0.into(), &SCENES.into())
    );

    // As stages: imports, passes through a sensor, and writes the scenes themselves as files.
    let (store, folder) = (farm.store(), path(&release).to_owned());
    let store = store.display();
    let job = format!(
        r#"name = "import"
[[stage]]
kind = "import"
import = {{ folder = "{folder}" }}
output = {{ store = "{store}", dataset = "by-stage" }}
[[stage]]
kind = "reprocess"
source = "import"
reprocess = {{ drop_left_over = true, sensor = {{ rebin = 4 }} }}
output = {{ store = "{store}", dataset = "coarse" }}
[[stage]]
name = "files"
kind = "generate"
scenes = {{ kind = "primitive", count = 3, seed = 5, spots = 4 }}
generate = {{ dest = "{store}/scenes", resolution = 32 }}
[[stage]]
name = "mitsuba"
kind = "generate"
scenes = {{ kind = "primitive", count = 1, seed = 5, spots = 4 }}
generate = {{ dest = "{store}/mitsuba", format = "mitsuba" }}
"#
    );
    let status = submit(&farm, &cli, &job);
    assert_eq!(status["tasks"]["done"], (2 * SCENES + 3 + 1), "{status}");
    let by_stage = farm.store().join("by-stage");
    assert_eq!(store::hashes(&by_stage), store::hashes(&target));
    assert_eq!(
        store::finished(&farm.store().join("coarse")).len() as u64,
        SCENES
    );

    // A broken scene is restored from its files when their location is given.
    let broken = target.join("transient/c/2/0/0/0");
    let bytes = fs::read(&broken).expect("published");
    fs::write(&broken, &bytes[..bytes.len() / 2]).expect("writable");
    let repair = ["dataset", "repair", path(&target)];
    cli.run(&repair)
        .fails(6, &["scene 2", "imported", "--files"]);
    let repaired = cli.json(&[&repair[..], &["--files", path(&release)]].concat());
    assert_eq!(
        repaired["scenes"][0]["written"],
        serde_json::json!([path(&broken)])
    );
    assert_eq!(store::hashes(&by_stage), store::hashes(&target));

    // A scene file is the scene that was rendered.
    let scene = farm.store().join("scenes/000002.glb");
    let shown = cli.json(&["scene", "show", path(&scene)]);
    let intrinsics = &shown["camera"]["intrinsics"];
    assert_eq!(
        (&intrinsics["width"], &shown["triangles"]),
        (&32.into(), &228.into())
    );
    assert!(farm.store().join("mitsuba/000000/scene.xml").is_file());

    // With --force, all results are the same.
    let before = store::hashes(&farm.store());
    let file = farm.scratch.join("job.toml");
    let job = cli.json(&["job", "submit", path(&file), "--force"])["job"].clone();
    cli.run(&["job", "wait", job.as_str().expect("it has an id")])
        .ok();
    assert_eq!(store::hashes(&farm.store()), before);
    drop(worker);
}

#[test]
fn an_import_that_cannot_go_on_says_why_and_goes_on_when_it_can() {
    let farm = Farm::start("imports-broken");
    let cli = farm.cli();
    let worker = farm.worker("source");
    let release = exported(&farm, &cli);
    drop(worker);
    let target = farm.scratch.join("set");
    let import = ["dataset", "import", path(&release), path(&target)];

    let depth = release.join("000002/depth.exr");
    let kept = fs::read(&depth).unwrap();
    fs::remove_file(&depth).unwrap();
    let refused = cli.run(&import).code(3);
    assert!(
        refused.stderr.contains("000002/depth.exr"),
        "{}",
        refused.stderr
    );
    assert!(!refused.stderr.contains("convert it"), "{}", refused.stderr);
    assert_eq!(store::finished(&target), [0, 1]);
    fs::write(&depth, &kept[..kept.len() / 2]).unwrap();
    cli.run(&import)
        .fails(3, &["000002/depth.exr", "ZIP_COMPRESSION"]);
    fs::write(&depth, kept).unwrap();
    let done = cli.json(&import);
    assert_eq!((&done["imported"], &done["found"]), (&2.into(), &2.into()));

    // Another release is not imported into the same data set.
    fs::remove_dir_all(release.join("000000")).unwrap();
    cli.run(&import).fails(3, &["manifests/0.json", "--list"]);
    cli.run(&["dataset", "import", path(&farm.store()), path(&target)])
        .fails(3, &["sb3d", "platonerf", "bf-lidar", "npy"]);
    cli.run(&[
        "dataset",
        "import",
        path(&release),
        path(&target),
        "--bins",
        "9",
    ])
    .fails(3, &["--bins", "sb3d"]);
}
