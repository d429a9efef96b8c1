//! Environments are built once, offline from a folder of wheels, and never by halves.

use std::sync::Arc;

use picofarm_tests::wheels;

use super::*;

/// A Python and a folder with wheels; the environments are in a subfolder.
struct Case {
    dir: tempfile::TempDir,
    python: Interpreter,
    variables: Vec<(&'static str, String)>,
}

impl Case {
    fn new() -> Option<Self> {
        let path = std::env::var_os("PICOFARM_PYTHON").unwrap_or_else(|| "python3".into());
        let python = Interpreter::find(Path::new(&path));
        let python = python.inspect_err(|why| eprintln!("skipped: {why}")).ok()?;
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("built")).unwrap();
        let variables = wheels::write(python.path().as_os_str(), dir.path())?.to_vec();
        Some(Self {
            dir,
            python,
            variables,
        })
    }

    fn run(&self, script: &str) -> Option<String> {
        output(&self.python, script)
    }

    fn folder(&self) -> PathBuf {
        self.dir.path().join("built")
    }

    fn build(&self, requirements: &[&str]) -> Result<Interpreter, TaskError> {
        self.within(requirements, &Control::default(), BUILD)
    }

    fn within(
        &self,
        requirements: &[&str],
        control: &Control,
        time: Duration,
    ) -> Result<Interpreter, TaskError> {
        let requirements: Vec<String> = requirements.iter().map(|&r| r.into()).collect();
        let folder = self.folder();
        let mut environment = Environment::new((&self.python, &folder), &requirements);
        environment.variables.clone_from(&self.variables);
        match environment.found() {
            Some(found) => Ok(found),
            None => environment.build((control, Instant::now() + time)),
        }
    }

    /// Returns the names in the folder of environments.
    fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.folder()).unwrap();
        let name = |entry: io::Result<fs::DirEntry>| entry.unwrap().file_name();
        let mut names: Vec<String> = entries
            .map(|entry| name(entry).into_string().unwrap())
            .collect();
        names.sort();
        names
    }
}

fn output(python: &Interpreter, script: &str) -> Option<String> {
    let ran = Command::new(python.path()).args(["-c", script]).output();
    let ran = ran.unwrap();
    ran.status
        .success()
        .then(|| String::from_utf8(ran.stdout).unwrap().trim().to_owned())
}

#[test]
fn an_environment_is_built_once_and_used_again_in_any_order_of_its_requirements() {
    let Some(case) = Case::new() else { return };
    let first = case.build(&["user==1.0", "tiny==1.0"]).unwrap();
    let version = "import tiny, user; print(tiny.VERSION)";
    assert_eq!(output(&first, version).as_deref(), Some("1.0"));
    assert_eq!(case.run(version), None);
    assert_eq!(case.names().len(), 3, "{:?}", case.names());

    fs::remove_file(case.dir.path().join("tiny-1.0-py3-none-any.whl")).unwrap();
    let again = case.build(&["tiny==1.0", "user==1.0"]).unwrap();
    assert_eq!(again, first);
    let other = case.build(&["user==1.0", "tiny==2.0"]).unwrap();
    assert_ne!(other, first);
    assert_eq!(output(&other, version).as_deref(), Some("2.0"));
}

#[test]
fn a_requirement_that_cannot_be_installed_is_named_and_nothing_is_left() {
    let Some(case) = Case::new() else { return };
    let wrong = format!("tiny==1.0 --hash=sha256:{}", "0".repeat(64));
    for (requirement, what) in [("absent==1.0", "absent"), (&wrong, "hash")] {
        match case.build(&["tiny==1.0", requirement][1..]) {
            Err(TaskError::Crash(told)) => {
                let told = told.to_lowercase();
                assert!(told.contains("python.requirements"), "{told}");
                assert!(told.matches(what).count() > 1, "{told}");
            }
            other => panic!("{other:?}"),
        }
    }
    let locks = |name: &String| !name.ends_with(".lock");
    assert_eq!(case.names().iter().filter(|name| locks(name)).count(), 0);
}

#[test]
fn what_a_killed_build_left_is_removed_and_a_broken_environment_is_built_again() {
    let Some(case) = Case::new() else { return };
    let first = case.build(&["tiny==1.0"]).unwrap();
    let venv = first.path().parent().unwrap().parent().unwrap();
    let folder = venv.parent().unwrap().to_owned();
    fs::remove_dir_all(venv.join("bin")).unwrap();
    let left = folder.with_file_name(format!("{}x", folder.file_name().unwrap().display()));
    fs::create_dir_all(left.join("venv/bin")).unwrap();

    let again = case.build(&["tiny==1.0"]).unwrap();
    assert_ne!(again.path(), first.path());
    assert!(output(&again, "import tiny").is_some());
    assert!(!left.exists() && !folder.exists());
}

#[test]
fn two_builds_of_an_environment_wait_for_each_other() {
    let Some(case) = Case::new() else { return };
    let built: Vec<_> = thread::scope(|scope| {
        let threads = [(); 2].map(|()| scope.spawn(|| case.build(&["tiny==1.0"])));
        threads.map(|thread| thread.join().unwrap().unwrap()).into()
    });
    assert_eq!(built[0], built[1]);
    assert_eq!(case.names().len(), 3, "{:?}", case.names());
}

#[test]
fn a_build_stops_with_its_worker_and_after_its_time() {
    let Some(case) = Case::new() else { return };
    let requirements = ["tiny==1.0".to_owned()];
    let folder = case.folder();
    let environment = Environment::new((&case.python, &folder), &requirements);
    let control = Arc::new(Control::default());
    let held = environment
        .lock((&control, Instant::now() + BUILD))
        .unwrap();
    let late = case.within(&["tiny==1.0"], &control, Duration::from_millis(1));
    match late {
        Err(TaskError::Interrupted(what)) => assert!(what.contains("tiny==1.0"), "{what}"),
        other => panic!("{other:?}"),
    }
    drop(held);
    // The time is up as soon as the builder runs.
    let late = case.within(&["tiny==1.0"], &control, Duration::ZERO);
    assert!(matches!(late, Err(TaskError::Interrupted(_))), "{late:?}");
    control.stop();
    let stopped = case.within(&["tiny==1.0"], &control, BUILD);
    assert_eq!(stopped, Err(TaskError::Stopped));
    assert_eq!(case.names().len(), 1, "{:?}", case.names());
}

#[test]
fn the_builder_ends_when_nobody_holds_its_input() {
    let Some(case) = Case::new() else { return };
    let folder = case.dir.path();
    fs::write(folder.join("build.py"), BUILDER).unwrap();
    // A named pipe that nobody writes makes it wait for ever.
    let made = Command::new("mkfifo").arg(folder.join("wait")).status();
    assert!(made.unwrap().success());
    let mut builder = Command::new(case.python.path());
    use std::os::unix::process::CommandExt;
    let builder = builder
        .args(["-I", "build.py", "venv", "wait"])
        .current_dir(folder)
        .stdin(Stdio::piped())
        .process_group(0)
        .spawn();
    let mut builder = builder.unwrap();
    drop(builder.stdin.take());
    assert!(!builder.wait().unwrap().success());
}
