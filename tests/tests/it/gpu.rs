//! GPUs on a farm: the assignment of stages that request one, and their results. On a machine
//! without a card, the tests use Mesa's software device. A program without the feature, or a
//! machine without any device, prints a message.

use std::{fs, path::Path, thread::sleep, time::Duration};

use picofarm_tests::{Farm, Process, Rooms, cli::Cli, scratch::Scratch, store};

/// Returns the name of a device, and whether it is a software device.
fn device() -> Option<(String, bool)> {
    let scratch = Scratch::new("gpu-devices");
    let listed = Cli::new(scratch.path()).json(&["model", "devices"]);
    let found = listed.as_array().unwrap().first().cloned();
    match &found {
        Some(gpu) => assert!(gpu["fault"].is_null(), "{gpu}"),
        None => eprintln!(
            "SKIPPED graphics processors: none is listed (build with --features picofarm/wgpu, Debian: mesa-vulkan-drivers)"
        ),
    }
    found.map(|gpu| {
        (
            gpu["name"].as_str().unwrap().to_owned(),
            gpu["kind"] == "software",
        )
    })
}

/// Returns a job that renders rooms, and trains, evaluates and runs a network on a GPU.
fn job(store: &Path, processes: u32) -> String {
    let rooms = Rooms::small(8).split_stages(store, [6, 1, 1]);
    format!(
        r#"
name = "gpu"
{rooms}[[stage]]
name = "tof"
kind = "train"
source = "rooms"
resources = {{ gpus = 1 }}
[stage.train]
target = "tof"
model = "tof"
net = {{ width = 4, levels = 2 }}
optimise = {{ epochs = 12, batch = 6, accumulate = 3 }}
processes = {processes}
[[stage]]
kind = "evaluate"
source = "rooms"
resources = {{ gpus = 1 }}
evaluate = {{ models = ["tof"] }}
[[stage]]
kind = "infer"
source = "rooms"
resources = {{ gpus = 1 }}
infer = {{ models = ["tof"] }}
output = {{ store = {store:?}, dataset = "seen" }}
"#
    )
}

fn submit(farm: &Farm, processes: u32) -> String {
    let file = farm.store().with_file_name("gpu.toml");
    fs::write(&file, job(&farm.store(), processes)).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"].as_str().unwrap().to_owned()
}

fn worker(farm: &Farm, name: &str, gpu: &str) -> Process {
    let args = [
        "worker",
        "--log",
        "info",
        "--name",
        name,
        "--threads",
        "1",
        "--gpus",
        gpu,
    ];
    farm.cli().start(name, &args)
}

#[test]
fn stages_that_ask_for_a_device_wait_for_workers_that_have_one_and_several_train_to_the_same_bits()
{
    let Some((gpu, _)) = device() else { return };
    let alone = Farm::with_lease("gpu-alone", 5.0);
    let id = submit(&alone, 1);
    let _one = worker(&alone, "one", &gpu);
    assert_eq!(alone.until_ended(&id)["state"], "done");

    let farm = Farm::with_lease("gpu-together", 5.0);
    let id = submit(&farm, 2);
    let _plain = farm.worker("plain");
    // A worker without a device completes all tasks that need none, and then nothing more.
    while farm.count(&id, "done") < 9 {
        sleep(Duration::from_millis(50));
    }
    sleep(Duration::from_millis(500));
    assert_eq!(farm.count(&id, "done"), 9);
    let said = farm.run(&["job", "explain", &id]).ok();
    assert!(said.stdout.contains("needs 1 GPUs"), "{}", said.stdout);
    let mut workers = [worker(&farm, "left", &gpu), worker(&farm, "right", &gpu)];
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let logs = workers.each_mut().map(|worker| worker.stderr());
    assert!(logs.iter().all(|log| log.contains(&gpu)), "{logs:?}");
    let made = |farm: &Farm| {
        let mut hashes = store::hashes(&farm.store().join("models"));
        hashes.retain(|key, _| key.contains("weights") || key.contains("history"));
        assert!(!hashes.is_empty());
        hashes
    };
    assert_eq!(made(&farm), made(&alone));
}

#[test]
fn a_worker_does_not_start_with_a_device_that_is_not_there() {
    let scratch = Scratch::new("gpu-refused");
    let cli = Cli::new(scratch.path());
    let refused = |gpus: &str, parts: &[&str]| {
        cli.run(&[
            "worker",
            "--coordinator",
            "http://127.0.0.1:9",
            "--gpus",
            gpus,
        ])
        .fails(3, parts);
    };
    let Some((gpu, software)) = device() else {
        return refused("1", &["gpus"]);
    };
    refused("wgpu:77", &["gpus", "wgpu:77", &gpu]);
    if software {
        refused("1", &["gpus", "0 can be used", "a software device"]);
    }
}
