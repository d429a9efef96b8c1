//! Processes that report, save, resume, fail, hang, flood and leave others behind.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
    thread,
    time::{Duration, Instant},
};

use bytes::Bytes;
use serde_json::{Map, Value, json};

use super::*;

/// Returns a Python, or `None` if this machine has none.
fn python() -> Option<Interpreter> {
    let path = std::env::var_os("PICOFARM_PYTHON").unwrap_or_else(|| "python3".into());
    let found = Interpreter::find(Path::new(&path));
    if let Err(why) = &found {
        eprintln!("skipped: {why}");
    }
    found.ok()
}

/// Remembers everything that a process sends.
#[derive(Default)]
struct Listener {
    reports: Vec<Report>,
    checkpoints: Vec<(u64, Vec<u8>)>,
    artifacts: BTreeMap<String, Vec<u8>>,
    /// The epoch after which the training is pruned.
    prune: Option<u64>,
    /// Stopped after the first report.
    control: Option<Arc<Control>>,
    heard: Arc<Mutex<u64>>,
}

impl Host for Listener {
    fn report(&mut self, report: Report) -> Result<Answer, TaskError> {
        let pruned = self.prune.is_some() && report.epoch == self.prune;
        self.reports.push(report);
        *self.heard.lock().unwrap() += 1;
        if let Some(control) = &self.control {
            control.stop();
        }
        Ok(if pruned {
            Answer::Stop("pruned")
        } else {
            Answer::Go
        })
    }

    fn checkpoint(&mut self, step: u64, file: &Path) -> Result<(), TaskError> {
        self.checkpoints.push((step, fs::read(file).unwrap()));
        Ok(())
    }

    fn artifact(&mut self, name: &str, file: &Path) -> Result<(), TaskError> {
        self.artifacts.insert(name.into(), fs::read(file).unwrap());
        Ok(())
    }
}

/// A run of a script.
struct Case<'a> {
    script: &'a str,
    parameters: Value,
    checkpoint: Option<Vec<u8>>,
    requirements: Vec<String>,
    patience: Patience,
}

impl<'a> Case<'a> {
    fn new(script: &'a str) -> Self {
        Self {
            script,
            parameters: json!({}),
            checkpoint: None,
            requirements: Vec::new(),
            patience: Patience {
                stop: Duration::from_secs(30),
                terminate: Duration::from_secs(5),
            },
        }
    }

    fn run(&self, host: &mut Listener, control: &Control) -> Option<Result<Ended, TaskError>> {
        let code = [(
            "train.py".to_owned(),
            Bytes::copy_from_slice(self.script.as_bytes()),
        )];
        let mut task = Map::new();
        task.insert("parameters".into(), self.parameters.clone());
        task.insert("checkpoint_minutes".into(), json!(0));
        let order = Order {
            entry: "train:main".into(),
            code: &code,
            requirements: &self.requirements,
            task,
            // Two pieces.
            checkpoint: self.checkpoint.as_ref().map(|bytes| {
                let (head, tail) = bytes.split_at(bytes.len() / 2);
                [head, tail].map(Bytes::copy_from_slice).to_vec()
            }),
            built: false,
            variables: vec![("GIVEN".into(), "yes".into())],
        };
        Some(super::run(
            &python()?,
            order,
            host,
            (control, self.patience),
        ))
    }
}

/// Runs a script to its end; `None` without a Python.
fn play(script: &str) -> Option<(Result<Ended, TaskError>, Listener)> {
    let mut host = Listener::default();
    let ended = Case::new(script).run(&mut host, &Control::default())?;
    Some((ended, host))
}

fn user(ended: Result<Ended, TaskError>) -> String {
    match ended {
        Err(TaskError::User(what)) => what,
        other => panic!("expected an error of the code, found {other:?}"),
    }
}

const TRAINING: &str = r#"
import os, pathlib
from picofarm import run

def main():
    assert os.environ["GIVEN"] == "yes"
    state = run.resume({"epoch": 0, "sum": 0.0})
    while state["epoch"] < run.parameters["epochs"]:
        state["epoch"] += 1
        state["sum"] += run.parameters["lr"]
        run.checkpoint(state, step=state["epoch"])
        run.report(epoch=state["epoch"], loss=1 / state["epoch"], sum=state["sum"])
    run.progress(1.0)
    pathlib.Path("weights.bin").write_bytes(b"w" * 10)
    run.artifact("weights.bin")
    run.artifact("weights.bin", name="again.bin")
    return {"sum": state["sum"]}
"#;

#[test]
fn a_process_reports_saves_publishes_and_resumes() {
    let mut host = Listener::default();
    let mut case = Case::new(TRAINING);
    case.parameters = json!({"epochs": 3, "lr": 0.5});
    let control = Control::default();
    let Some(ended) = case.run(&mut host, &control) else {
        return;
    };
    let Ok(Ended::Done { result, facts }) = ended else {
        panic!("{ended:?}");
    };
    assert_eq!(result, json!({"sum": 1.5}));
    assert_eq!(facts["python"], json!(python().unwrap().version()));
    assert_eq!(control.fraction(), 1.0);
    let epochs: Vec<Option<u64>> = host.reports.iter().map(|r| r.epoch).collect();
    assert_eq!(epochs, [Some(1), Some(2), Some(3)]);
    assert_eq!(host.reports[1].metrics["loss"], Some(0.5));
    assert_eq!(host.artifacts["again.bin"], b"wwwwwwwwww");
    assert_eq!(host.artifacts.len(), 2);
    // The second checkpoint leads to the same end.
    let (step, state) = host.checkpoints[1].clone();
    assert_eq!(step, 2);
    case.checkpoint = Some(state);
    let mut resumed = Listener::default();
    let again = case.run(&mut resumed, &Control::default()).unwrap();
    let Ok(Ended::Done { result, .. }) = again else {
        panic!("{again:?}");
    };
    assert_eq!(result, json!({"sum": 1.5}));
    assert_eq!(resumed.reports, host.reports[2..]);
}

#[test]
fn bytes_and_folders_come_back_from_a_checkpoint_as_they_were() {
    let script = r#"
import pathlib
from picofarm import run
def main():
    found = run.resume()
    if isinstance(found, bytes):
        return found.decode()
    if found is not None:
        return [found.name, (found / "a" / "b.txt").read_text()]
    run.checkpoint(b"some bytes", step=1, now=True)
    folder = pathlib.Path("kept/a"); folder.mkdir(parents=True)
    (folder / "b.txt").write_text("in a folder")
    run.checkpoint(lambda: folder.parent, step=2, now=True)
"#;
    let Some((ended, host)) = play(script) else {
        return;
    };
    assert!(matches!(ended, Ok(Ended::Done { .. })), "{ended:?}");
    let expected = [json!("some bytes"), json!(["kept", "in a folder"])];
    for ((_, state), expected) in host.checkpoints.into_iter().zip(expected) {
        let mut case = Case::new(script);
        case.checkpoint = Some(state);
        let ended = case.run(&mut Listener::default(), &Control::default());
        match ended.unwrap() {
            Ok(Ended::Done { result, .. }) => assert_eq!(result, expected),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn temporary_files_go_with_the_folder_of_the_task() {
    let code = "import os, tempfile\ndef main():\n    inside = tempfile.gettempdir().startswith(os.environ['PICOFARM_RUN'])\n    raise ValueError(f'inside {inside}')\n";
    if let Some((ended, _)) = play(code) {
        let what = user(ended);
        assert!(what.contains("inside True"), "{what}");
    }
}

#[test]
fn a_failure_names_the_last_lines_of_the_traceback() {
    let Some((ended, _)) =
        play("def main():\n    print('begun')\n    raise ValueError('bad lr')\n")
    else {
        return;
    };
    let what = user(ended);
    assert!(
        what.contains("status 1") && what.contains("ValueError: bad lr"),
        "{what}"
    );
    assert!(
        what.contains("\"train.py\", line 3") && !what.contains("runner.py"),
        "{what}"
    );
    let (ended, _) = play("import nothing_of_this_name\n").unwrap();
    assert!(user(ended).contains("nothing_of_this_name"));
    let (ended, _) = play("def other(): pass\n").unwrap();
    assert!(user(ended).contains("has no function 'main'"));
    let (ended, _) = play("import os\ndef main(): os._exit(0)\n").unwrap();
    assert!(user(ended).contains("without a result"));
    let (ended, _) = play("import os\ndef main(): os.kill(os.getpid(), 11)\n").unwrap();
    match ended {
        Err(TaskError::Crash(what)) => assert!(what.contains("signal 11"), "{what}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_missing_requirement_is_named_before_the_code_runs() {
    let mut case = Case::new("raise SystemExit('it ran')\n");
    case.requirements = vec!["no-such-thing==1.0".into()];
    let Some(ended) = case.run(&mut Listener::default(), &Control::default()) else {
        return;
    };
    match ended {
        Err(TaskError::Crash(what)) => {
            assert!(
                what.contains("no-such-thing==1.0 is not installed"),
                "{what}"
            );
            assert!(!what.contains("it ran"));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn garbage_and_floods_end_the_process_and_wrong_names_are_errors_of_the_code() {
    let speak = |bytes: &str| {
        format!(
            "import os, socket, time\ndef main():\n    s = socket.socket(socket.AF_UNIX)\n    \
             s.connect(os.environ['PICOFARM_RUN'] + '/socket')\n    s.sendall({bytes})\n    time.sleep(60)\n"
        )
    };
    let begun = Instant::now();
    let Some((ended, _)) = play(&speak("b'hello\\n'")) else {
        return;
    };
    let what = user(ended);
    assert!(
        what.contains("hello") && what.contains("is no message"),
        "{what}"
    );
    let (ended, _) = play(&speak("b'x' * (2 << 20)")).unwrap();
    assert!(user(ended).contains("more than 1 MiB"));
    let (ended, _) = play(&speak(r#"b'{"progress": "much"}\n'"#)).unwrap();
    assert!(user(ended).contains("is no message"));
    assert!(begun.elapsed() < Duration::from_secs(40));
    let named = "from picofarm import run\ndef main():\n    open('a', 'w').close()\n    run.artifact('a', name='../a')\n";
    let (ended, _) = play(named).unwrap();
    assert!(user(ended).contains("artifact \"../a\": expected up to 128 letters"));
    let outside = "from picofarm import run\ndef main():\n    run._worker.ask({'checkpoint': {'step': 1, 'path': '/etc/passwd'}})\n";
    let (ended, _) = play(outside).unwrap();
    assert!(user(ended).contains("outside of the task's folder"));
}

#[test]
fn a_pruned_training_ends_by_itself() {
    let mut host = Listener {
        prune: Some(2),
        ..Listener::default()
    };
    let mut case = Case::new(TRAINING);
    case.parameters = json!({"epochs": 9, "lr": 0.5});
    let Some(ended) = case.run(&mut host, &Control::default()) else {
        return;
    };
    assert_eq!(ended, Ok(Ended::Stopped));
    assert_eq!(host.reports.len(), 2);
}

#[test]
fn a_stopping_worker_gets_a_checkpoint_first() {
    let control = Arc::new(Control::default());
    let mut host = Listener {
        control: Some(control.clone()),
        ..Listener::default()
    };
    // Nothing is due for an hour, but when the worker stops.
    let script = "from picofarm import run\ndef main():\n    run._TASK['checkpoint_minutes'] = 60\n    for i in range(1, 1000):\n        \
                  run.checkpoint({'i': i}, step=i)\n        run.report(step=i, loss=1.0)\n";
    let Some(ended) = Case::new(script).run(&mut host, &control) else {
        return;
    };
    assert_eq!(ended, Err(TaskError::Stopped));
    let steps: Vec<u64> = host.checkpoints.iter().map(|(step, _)| *step).collect();
    assert_eq!(steps, [2]);
}

/// Returns whether a process runs.
fn alive(pid: &str) -> bool {
    let state = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    !state.is_empty() && !state.contains(") Z ")
}

#[test]
fn a_process_that_hangs_is_killed_with_everything_below_it() {
    let dir = tempfile::tempdir().unwrap();
    let noted: PathBuf = dir.path().join("pids");
    // Neither the code nor its child, in a session of its own, ends on request.
    let script = format!(
        "import os, signal, subprocess, time\ndef main():\n    signal.signal(signal.SIGTERM, signal.SIG_IGN)\n    \
         child = subprocess.Popen(['sleep', '600'], start_new_session=True)\n    \
         open('{0}.new', 'w').write(f'{{os.getpid()}} {{child.pid}}')\n    os.rename('{0}.new', '{0}')\n    time.sleep(600)\n",
        noted.display()
    );
    let control = Arc::new(Control::default());
    let (stopper, file) = (control.clone(), noted.clone());
    let stopping = thread::spawn(move || {
        let until = Instant::now() + Duration::from_secs(60);
        while !file.exists() && Instant::now() < until {
            thread::sleep(Duration::from_millis(10));
        }
        stopper.stop();
    });
    let mut case = Case::new(&script);
    case.patience = Patience {
        stop: Duration::from_millis(200),
        terminate: Duration::from_millis(200),
    };
    let ended = case.run(&mut Listener::default(), &control);
    stopping.join().unwrap();
    let Some(ended) = ended else { return };
    assert_eq!(ended, Err(TaskError::Stopped));
    let pids = fs::read_to_string(&noted).unwrap();
    for pid in pids.split(' ') {
        assert!(!alive(pid), "{pid} still runs");
    }
}

#[test]
fn a_path_that_is_no_python_is_refused() {
    let refused = Interpreter::find(Path::new("/bin/true")).unwrap_err();
    assert!(refused.contains("is no Python"), "{refused}");
    let refused = Interpreter::find(Path::new("/nowhere/python")).unwrap_err();
    assert!(
        refused.contains("cannot start /nowhere/python"),
        "{refused}"
    );
}
