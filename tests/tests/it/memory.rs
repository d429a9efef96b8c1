//! Compares estimated memory with the maximum memory of real workers. Each kind of task runs on a
//! worker of its own.

use std::{fs, path::Path};

use picofarm_tests::{Farm, Process, wait::until};
use serde_json::Value;

/// Maximum and minimum ratio of an estimate to the measured memory. (The maximum memory of the same
/// task differs by a third between runs.)
const MOST: f64 = 2.5;
const LEAST: f64 = 0.75;
/// Number of threads that a plan assumes.
const THREADS: u32 = 8;

fn job(store: &Path, side: u32, samples: u32) -> String {
    let stage = |name: &str, body: &str| {
        format!("[[stage]]\nname = {name:?}\nresources = {{ labels = [{name:?}] }}\n{body}\n")
    };
    let at = store.display();
    let render = format!(
        "scenes = {{ kind = \"primitive\", count = 4, seed = 3, spots = 4 }}\n\
         render = {{ resolution = {side}, samples = {samples}, bins = 500, bin_width_m = 0.0384, per_spot = true }}"
    );
    let whole = render.replace("per_spot = true", "per_spot = false");
    let out = |name: &str| format!("output = {{ store = \"{at}\", dataset = {name:?} }}");
    let net = "net = { width = 16, levels = 3 }\noptimise = { epochs = 1, batch = 2 }";
    [
        "name = \"memory\"\n".to_owned(),
        stage("render", &format!("{render}\n{}", out("rooms"))),
        stage("joined", &format!("{whole}\nparts = 2\n{}", out("joined"))),
        stage(
            "generate",
            &format!(
                "kind = \"generate\"\nscenes = {{ kind = \"furnished\", assets = \"parametric\", count = 2 }}\n\
                 generate = {{ dest = \"{at}/files\" }}"
            ),
        ),
        stage(
            "reprocess",
            &format!("kind = \"reprocess\"\nsource = \"render\"\n{}", out("sensed")),
        ),
        stage(
            "spots",
            &format!(
                "kind = \"reprocess\"\nsource = \"render\"\n\
                 reprocess = {{ histogram = \"transient_spots\", spots = [0, 2] }}\n{}",
                out("two")
            ),
        ),
        stage("verify", "kind = \"verify\"\nsource = \"joined\""),
        stage("split", "kind = \"split\"\nsource = \"render\"\nsplit = { counts = [2, 1, 1] }"),
        stage(
            "export",
            &format!("kind = \"export\"\nsource = \"joined\"\nexport = {{ dest = \"{at}/h5\", format = \"hdf5\" }}"),
        ),
        stage(
            "train",
            &format!(
                "kind = \"train\"\nsource = \"render\"\nneeds = [\"split\"]\n[stage.train]\ntarget = \"tof\"\nmodel = \"tof\"\n{net}"
            ),
        ),
        stage("evaluate", "kind = \"evaluate\"\nsource = \"render\"\nevaluate = { models = [\"tof\"] }"),
        stage(
            "infer",
            &format!(
                "kind = \"infer\"\nsource = \"render\"\ninfer = {{ models = [\"tof\"] }}\n{}",
                out("seen")
            ),
        ),
        stage(
            "demultiplex",
            &format!(
                "kind = \"demultiplex\"\nsource = \"render\"\n{}",
                out("apart")
            ),
        ),
        stage(
            "reconstruct",
            &format!(
                "kind = \"reconstruct\"\nsource = \"render\"\n\
                 reconstruct = {{ from = \"captures\", grid = {{ nodes = 192, iterations = 3 }} }}\n{}",
                out("rooms-3d")
            ),
        ),
        stage("single", &format!("{}\n{}", render.replace("count = 4", "count = 1"), out("capture"))),
        stage(
            "calibrate",
            &format!(
                "kind = \"calibrate\"\nsource = \"single\"\ncalibrate = {{ accept_unexplained = true }}\n{}",
                out("calibrated")
            ),
        ),
        stage("report", "kind = \"report\"\nreport = { name = \"all\", models = [\"tof\"] }"),
    ]
    .concat()
}

/// Returns the maximum memory that a worker used while it ran the stages of a label to their end.
fn measured(farm: &Farm, job: &str, label: &str) -> f64 {
    let threads = THREADS.to_string();
    let args = [
        "worker",
        "--name",
        label,
        "--label",
        label,
        "--threads",
        &threads,
    ];
    let url = ["--coordinator", farm.url()];
    let worker = farm.cli().start(label, &[&args[..], &url].concat());
    until(&format!("the end of {label}"), || {
        let status = farm.status(job);
        assert_eq!(status["tasks"]["dead"], 0, "{status}");
        let stages = status["stages"].as_array().expect("a status has stages");
        let of = |s: &&Value| {
            s["name"]
                .as_str()
                .is_some_and(|name| name.split('.').next() == Some(label))
        };
        let mut ours = stages.iter().filter(of).peekable();
        assert!(ours.peek().is_some(), "{status}");
        ours.all(|s| s["state"] == "done").then_some(())
    });
    high_water(&worker)
}

fn high_water(process: &Process) -> f64 {
    let status = fs::read_to_string(format!("/proc/{}/status", process.id())).unwrap();
    let peak = status
        .lines()
        .find_map(|l| l.strip_prefix("VmHWM:"))
        .unwrap();
    1024.0 * peak.trim().trim_end_matches(" kB").parse::<f64>().unwrap()
}

#[test]
fn estimates_are_near_the_largest_memory_of_each_kind_of_task() {
    let farm = Farm::start("memory");
    let side = 192;
    let file = farm.scratch.join("memory.toml");
    fs::write(&file, job(&farm.store(), side, 2)).unwrap();
    let shown = farm.json(&["job", "plan", file.to_str().unwrap()]);
    let id = farm.json(&["job", "submit", file.to_str().unwrap()]);
    let id = id["job"].as_str().unwrap();
    // A stage in parts appears as two stages, which run on one worker.
    let mut estimates: Vec<(String, f64)> = Vec::new();
    for stage in shown["stages"].as_array().unwrap() {
        let label = stage["name"].as_str().unwrap().split('.').next().unwrap();
        let bytes = stage["memory_bytes"].as_f64().unwrap();
        match estimates.last_mut() {
            Some((last, most)) if last == label => *most = most.max(bytes),
            _ => estimates.push((label.to_owned(), bytes)),
        }
    }
    let mut wrong = Vec::new();
    for (label, estimate) in estimates {
        let peak = measured(&farm, id, &label);
        let share = estimate / peak;
        let (estimate, peak) = (estimate / 1e6, peak / 1e6);
        let line =
            format!("{label}: estimated {estimate:.0} MB, measured {peak:.0} MB, {share:.2}");
        eprintln!("{line}");
        if !(LEAST..=MOST).contains(&share) {
            wrong.push(line);
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
