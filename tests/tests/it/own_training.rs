//! Own training: code of a job on workers that run Python. It is refused without the options of
//! coordinator and worker, resumes after the death of a worker without leaving a process behind,
//! and is swept. Runs if `PICOFARM_PYTHON` names a Python.

use std::{fs, path::Path};

use picofarm_tests::{Farm, Process, Signal, wait::until, wheels};
use serde_json::Value;

/// Fits a line by gradient descent, slowly enough for the death of a worker.
const TRAINING: &str = r#"
import json, os, pathlib, time
from picofarm import run

def main():
    state = run.resume({"epoch": 0, "w": 0.0, "pids": []})
    state["pids"].append(os.getpid())
    if "pid" in run.parameters:
        pathlib.Path(run.parameters["pid"]).write_text(str(os.getpid()))
    while state["epoch"] < run.parameters["epochs"]:
        time.sleep(run.parameters["wait"])
        state["w"] -= run.parameters["lr"] * 2 * (state["w"] - 3.0)
        state["epoch"] += 1
        print("epoch", state["epoch"], "is over")
        run.report(epoch=state["epoch"], loss=(state["w"] - 3.0) ** 2)
        run.checkpoint(state, step=state["epoch"])
    pathlib.Path("weights.json").write_text(json.dumps(state))
    run.artifact("weights.json")
"#;

/// Returns the path of a Python, or `None` without one.
fn python(name: &str) -> Option<String> {
    let python = std::env::var("PICOFARM_PYTHON").ok();
    if python.is_none() {
        eprintln!("SKIPPED {name}: PICOFARM_PYTHON names no Python");
    }
    python
}

/// Starts a worker that runs Python code.
fn worker(farm: &Farm, name: &str, python: &str) -> Process {
    let args = ["worker", "--log", "info", "--name", name, "--threads", "1"];
    let more = ["--coordinator", farm.url(), "--python", python];
    farm.cli().start(name, &[&args[..], &more].concat())
}

/// Starts the coordinator again, which then accepts code.
fn allow(farm: &mut Farm) {
    farm.kill_coordinator();
    farm.start_coordinator_with(&["--allow-python", "all"]);
}

/// Writes the code and a job, and returns the job file.
fn write(farm: &Farm, name: &str, text: &str) -> String {
    let dir = farm.store().with_file_name(name);
    fs::create_dir_all(&dir).unwrap();
    fs::write(dir.join("train.py"), TRAINING).unwrap();
    let file = dir.join("job.toml");
    fs::write(&file, text).unwrap();
    file.to_str().unwrap().to_owned()
}

fn alone(store: &Path, pid: &Path) -> String {
    format!(
        r#"
name = "own"
[limits]
max_crashes = 1000
[[stage]]
kind = "python"
[stage.python]
file = "train.py"
entry = "main"
model = "line"
store = {store:?}
objective = "loss"
epochs = 40
checkpoint_minutes = 0
parameters = {{ epochs = 40, lr = 0.1, wait = 0.05, pid = {pid:?} }}
"#
    )
}

/// Waits until a process is gone.
fn until_gone(pid: &str) {
    let stat = format!("/proc/{pid}/stat");
    until("the code's process to end", || {
        let state = fs::read_to_string(&stat).unwrap_or_default();
        (state.is_empty() || state.contains(") Z ")).then_some(())
    });
}

#[test]
fn code_runs_where_it_is_allowed_and_resumes_after_the_death_of_its_worker() {
    let Some(python) = python("own training") else {
        return;
    };
    let mut farm = Farm::with_lease("own", 2.0);
    let store = farm.store();
    let noted = farm.scratch.join("pid");
    let file = write(&farm, "alone", &alone(&store, &noted));
    let refused = farm.run(&["job", "submit", &file]);
    refused.fails(3, &["--allow-python"]);

    allow(&mut farm);
    let answer = farm.json(&["job", "submit", &file]);
    let id = answer["job"].as_str().unwrap().to_owned();
    let _plain = farm.worker("plain");
    let explained = until("the reason why the job waits", || {
        let told = farm.run(&["job", "explain", &id]).ok().stdout;
        told.contains("--python").then_some(told)
    });
    assert!(explained.contains("no Python code"), "{explained}");

    let mut first = worker(&farm, "first", &python);
    first.until_says("epoch 5 is over");
    let pid = fs::read_to_string(&noted).unwrap();
    first.kill();
    until_gone(&pid);
    let second = worker(&farm, "second", &python);
    assert_eq!(farm.until_ended(&id)["state"], "done");
    assert!(second.stderr().contains("goes on from the checkpoint"));

    let place = store.to_str().unwrap();
    let shown = farm.json(&["model", "show", place, "line"]);
    let manifest = &shown["manifest"];
    assert_eq!(manifest["kind"], "python");
    assert_eq!(manifest["metrics"]["epochs"], 40);
    assert_eq!(manifest["metrics"]["reports"], 40);
    assert_eq!(manifest["metrics"]["repeatable"], false);
    let key = |object: &&Value| object["key"].as_str().unwrap().ends_with("weights.json");
    let objects = manifest["objects"].as_array().unwrap();
    let weights = objects.iter().find(key).unwrap()["key"].as_str().unwrap();
    let weights = fs::read_to_string(store.join("models/line").join(weights)).unwrap();
    let weights: Value = serde_json::from_str(&weights).unwrap();
    let pids = weights["pids"].as_array().unwrap();
    assert_eq!(pids.len(), 2, "{weights}");
    assert_eq!(pids[0].to_string(), pid);
    // The same code and parameters are not run again, other code is another training.
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!(plan["reuse"], 1, "{plan}");
    let code = Path::new(&file).with_file_name("train.py");
    fs::write(&code, format!("{TRAINING}\n# another\n")).unwrap();
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!(plan["run"], 1, "{plan}");
}

#[test]
fn a_sweep_over_own_code_stops_what_falls_behind_and_names_the_best() {
    let Some(python) = python("sweep over own code") else {
        return;
    };
    let mut farm = Farm::with_lease("own-sweep", 2.0);
    allow(&mut farm);
    let store = farm.store();
    let text = format!(
        r#"
name = "own sweep"
[[stage]]
name = "fit"
kind = "python"
[stage.sweep]
stop = {{ halving = {{ first = 2, factor = 3 }} }}
over = {{ lr = [0.2, 1e-6, 0.3, 1e-5, 0.4, 1e-4] }}
[stage.python]
file = "train.py"
entry = "main"
model = "line"
store = {store:?}
objective = "loss"
epochs = 12
parameters = {{ epochs = 12, lr = "{{lr}}", wait = 0 }}
"#
    );
    let file = write(&farm, "sweep", &text);
    let answer = farm.json(&["job", "submit", &file]);
    let id = answer["job"].as_str().unwrap().to_owned();
    let _one = worker(&farm, "one", &python);
    assert_eq!(farm.until_ended(&id)["state"], "done");

    let place = store.to_str().unwrap();
    let sweep = farm.json(&["sweep", "status", place, "line"]);
    let trials = sweep["trials"].as_array().unwrap();
    let ended = |end: &str| trials.iter().filter(|t| t["end"] == end).count();
    assert_eq!(trials.len(), 6, "{sweep}");
    assert!(ended("finished") >= 1 && ended("pruned") >= 1, "{sweep}");
    assert_eq!(ended("finished") + ended("pruned"), 6, "{sweep}");
    let best = farm.json(&["sweep", "best", place, "line"]);
    let named = farm.json(&["model", "show", place, "line"]);
    let promoted = &named["manifest"]["lineage"]["promoted"];
    assert_eq!(promoted["model"], best["model"], "{named}");
    assert!(promoted["values"]["lr"].as_f64().unwrap() > 0.1, "{named}");

    let table = farm.scratch.join("curves.csv");
    let out = table.to_str().unwrap();
    farm.run(&["sweep", "export", place, "line", "--curves", "--out", out])
        .ok();
    let text = std::fs::read_to_string(&table).unwrap();
    // The code reports neither a learning rate nor a loss of its own.
    assert!(
        text.starts_with("trial,epoch,step,objective\r\n0,1,"),
        "{text}"
    );
}

#[test]
fn a_failure_of_the_code_is_the_jobs_and_a_worker_that_stops_saves_first() {
    let Some(python) = python("failing code") else {
        return;
    };
    let mut farm = Farm::with_lease("own-failure", 2.0);
    allow(&mut farm);
    let pid = farm.scratch.join("pid");
    let text = alone(&farm.store(), &pid).replace("lr = 0.1, ", "");
    let file = write(&farm, "failing", &text);
    let answer = farm.json(&["job", "submit", &file]);
    let id = answer["job"].as_str().unwrap().to_owned();
    let mut one = worker(&farm, "one", &python);
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    let told = farm.run(&["job", "logs", &id]).ok().stdout;
    assert!(told.contains("KeyError: 'lr'"), "{told}");

    // Nothing is due for an hour, so the checkpoint is that of the worker's end.
    let text = alone(&farm.store(), &pid)
        .replace("checkpoint_minutes = 0", "checkpoint_minutes = 60")
        .replace("name = \"own\"", "name = \"stopped\"")
        .replace("model = \"line\"", "model = \"stopped\"");
    let file = write(&farm, "stopped", &text);
    let answer = farm.json(&["job", "submit", &file]);
    let id = answer["job"].as_str().unwrap().to_owned();
    one.until_says("epoch 5 is over");
    one.signal(Signal::Terminate);
    one.end();
    let folder = farm.store().join("models/stopped/checkpoints");
    assert!(folder.is_dir(), "{}", folder.display());
    let two = worker(&farm, "two", &python);
    assert_eq!(farm.until_ended(&id)["state"], "done");
    assert!(two.stderr().contains("goes on from the checkpoint"));
}

#[test]
fn a_worker_installs_what_the_code_requires() {
    let Some(python) = python("environments") else {
        return;
    };
    let mut farm = Farm::with_lease("own-environment", 2.0);
    let store = farm.store();
    let Some(variables) = wheels::write(python.as_ref(), farm.scratch.path()) else {
        return;
    };
    allow(&mut farm);
    let file = write(
        &farm,
        "required",
        &format!(
            r#"
name = "required"
[[stage]]
kind = "python"
[stage.python]
file = "train.py"
model = "versions"
store = {store:?}
requirements = ["user==1.0", "tiny==2.0"]
"#
        ),
    );
    let code = Path::new(&file).with_file_name("train.py");
    let script = "import user, tiny\nfrom picofarm import run\nrun.report(step=1, version=float(tiny.VERSION))\n";
    fs::write(code, script).unwrap();
    let id = farm.json(&["job", "submit", &file])["job"]
        .as_str()
        .unwrap()
        .to_owned();

    let folder = farm.scratch.join("environments");
    let args = [
        "worker",
        "--threads",
        "1",
        "--coordinator",
        farm.url(),
        "--python",
        &python,
    ];
    let more = ["--python-environments", folder.to_str().unwrap()];
    let cli = variables
        .iter()
        .fold(farm.cli(), |cli, (name, value)| cli.with(name, value));
    let _worker = cli.start("installing", &[&args[..], &more].concat());
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let shown = farm.json(&["model", "show", store.to_str().unwrap(), "versions"]);
    let metrics = &shown["manifest"]["metrics"];
    assert_eq!(metrics["latest"]["version"], 2.0, "{metrics}");
    let versions = &metrics["environment"]["versions"];
    assert_eq!(versions["tiny"], "2.0", "{metrics}");
    assert_eq!(versions["user"], "1.0", "{metrics}");
}
