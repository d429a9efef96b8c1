//! Jobs of several stages with real processes: killed half-way, run again, changed, forced, paused,
//! drained.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use picofarm_tests::{Cli, Farm, Process, rng::Rng, store, wait::until};
use serde_json::Value;

/// Returns a job that renders, passes the scenes through two sensors, splits one of the results,
/// and exports its training side.
fn graph(store: &Path, scenes: u64, dark: &str) -> String {
    let store = store.display();
    format!(
        r#"name = "graph"
[limits]
max_crashes = 1000
[[stage]]
name = "render"
scenes = {{ kind = "primitive", count = {scenes}, seed = 3, spots = 4 }}
render = {{ resolution = 16, samples = 4, bin_width_m = 0.384, bins = 64 }}
output = {{ store = "{store}", dataset = "clean" }}
[[stage]]
name = "noise"
kind = "reprocess"
source = "render"
matrix = {{ dark = [{dark}] }}
reprocess = {{ sensor = {{ dark_per_bin = "{{dark}}" }} }}
output = {{ store = "{store}", dataset = "dark-{{dark}}", profile = "counts-u16" }}
[[stage]]
name = "split"
kind = "split"
source = "noise[0.5]"
split = {{ fractions = [0.5, 0.25, 0.25] }}
[[stage]]
name = "export"
kind = "export"
source = "noise[0.5]"
needs = ["split"]
export = {{ dest = "{store}/packed", scenes = "split:train" }}
"#
    )
}

struct Graph {
    farm: Farm,
    cli: Cli,
    file: PathBuf,
}

impl Graph {
    fn new(name: &str, scenes: u64) -> Self {
        let farm = Farm::start(name);
        let file = farm.scratch.join("graph.toml");
        let graph = Self {
            cli: farm.cli(),
            farm,
            file,
        };
        graph.write(&graph.text(scenes, "0.0, 0.5"));
        graph
    }

    fn text(&self, scenes: u64, dark: &str) -> String {
        graph(&self.farm.store(), scenes, dark)
    }

    fn write(&self, text: &str) {
        std::fs::write(&self.file, text).expect("the folder is there");
    }

    fn file(&self) -> &str {
        self.file.to_str().expect("plain")
    }

    fn submit(&self, more: &[&str]) -> String {
        let args = [&["job", "submit", self.file()], more].concat();
        let submitted = self.cli.json(&args);
        submitted["job"].as_str().expect("it has an id").to_owned()
    }

    fn status(&self, job: &str) -> Value {
        self.cli.json(&["job", "status", job])
    }

    fn until_ended(&self, job: &str) -> Value {
        until("the job to end", || {
            let status = self.status(job);
            (status["state"] != "active").then_some(status)
        })
    }

    /// Returns every object, except those that a killed worker may leave while it probes the store.
    fn objects(&self) -> BTreeMap<String, String> {
        let mut all = store::hashes(&self.farm.store());
        all.retain(|name, _| {
            !name.starts_with(".probe-") && !name.ends_with(".picofarm-store.json")
        });
        all
    }

    /// Returns the number of computed tasks, according to the workers' logs.
    fn computed(&self) -> u64 {
        self.farm.logged("task done")
    }
}

fn ended_well(status: &Value) {
    assert_eq!(status["state"], "done", "{status}");
}

#[test]
fn a_graph_whose_workers_are_killed_again_and_again_gives_what_an_undisturbed_one_gives() {
    let calm = Graph::new("graph-calm", 8);
    let job = calm.submit(&[]);
    let _worker = calm.farm.worker("calm");
    ended_well(&calm.until_ended(&job));
    drop(_worker);

    let wild = Graph::new("graph-wild", 8);
    let job = wild.submit(&[]);
    let mut rng = Rng::new(5);
    let mut kills = 0;
    loop {
        let worker = wild.farm.worker(&format!("wild-{kills}"));
        std::thread::sleep(std::time::Duration::from_millis(
            150 + (rng.unit() * 400.0) as u64,
        ));
        if wild.status(&job)["state"] != "active" || kills == 12 {
            ended_well(&wild.until_ended(&job));
            break;
        }
        worker.kill();
        kills += 1;
    }
    assert!(kills > 1, "it was struck in the middle");
    assert_eq!(wild.objects(), calm.objects());
    let packed = wild.farm.store().join("packed/zarr.json");
    assert!(packed.is_file(), "the last stage has made its result");
}

#[test]
fn another_sensor_over_rendered_scenes_renders_nothing_and_force_proves_the_results() {
    let graph = Graph::new("graph-again", 4);
    let job = graph.submit(&[]);
    let worker = graph.farm.worker("first");
    ended_well(&graph.until_ended(&job));
    let first = graph.computed();
    assert_eq!(first, 4 + 8 + 1 + 1);
    let before = store::times(&graph.farm.store().join("clean"));

    graph.write(&graph.text(4, "0.0, 0.5, 1.0"));
    let plan = graph.cli.json(&["job", "plan", graph.file()]);
    // An export leaves no result that the coordinator could compare, so a worker checks it again.
    assert_eq!((&plan["reuse"], &plan["run"]), (&13.into(), &5.into()));
    let stages = plan["stages"].as_array().expect("a plan has stages");
    let new = stages.iter().find(|s| s["name"] == "noise[1.0]");
    let why = new.expect("it is planned")["reasons"].to_string();
    assert!(
        why.contains("reprocess.sensor.dark_per_bin is 1.0 and was 0."),
        "{why}"
    );
    let job = graph.submit(&[]);
    ended_well(&graph.until_ended(&job));
    assert!((first + 4..=first + 5).contains(&graph.computed()));
    assert_eq!(store::times(&graph.farm.store().join("clean")), before);

    // From a given stage on, each task runs again with the same result.
    let objects = graph.objects();
    let job = graph.submit(&["--from-stage", "noise[0.5]"]);
    let status = graph.until_ended(&job);
    ended_well(&status);
    assert!(graph.computed() >= first + 4 + 4, "they did run");
    assert_eq!(graph.objects(), objects);
    let alarms = graph.cli.run(&["events"]).ok().stdout;
    assert!(!alarms.contains("alarm"), "{alarms}");
    worker.kill();
}

#[test]
fn a_held_job_waits_and_a_drained_worker_ends_after_its_task() {
    let graph = Graph::new("graph-held", 6);
    let job = graph.submit(&[]);
    graph.cli.run(&["job", "pause", &job]).ok();
    let worker: Process = graph.farm.worker("patient");
    until("the worker to connect", || {
        let workers = graph.cli.json(&["workers"]);
        (workers["workers"].as_array()?.len() == 1).then_some(())
    });
    let status = graph.status(&job);
    assert_eq!(
        (&status["paused"], &status["tasks"]["done"]),
        (&true.into(), &0.into())
    );
    let explained = graph.cli.run(&["job", "explain", &job]).ok().stdout;
    assert!(explained.contains("is held"), "{explained}");
    graph.cli.run(&["job", "resume", &job]).ok();
    until("a task to be done", || {
        (graph.status(&job)["tasks"]["done"].as_u64()? > 0).then_some(())
    });
    graph.cli.run(&["workers", "drain", "patient"]).ok();
    let ended = worker.end();
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let status = graph.status(&job);
    let tasks = &status["tasks"];
    if status["state"] == "active" {
        assert_eq!(tasks["leased"], 0, "{status}");
    }
    let unknown = graph.cli.run(&["workers", "drain", "nobody"]);
    assert_ne!(unknown.code, Some(0));
    assert!(unknown.stderr.contains("nobody"), "{}", unknown.stderr);
    let _other = graph.farm.worker("other");
    ended_well(&graph.until_ended(&job));
}
