//! Virtual environments for Python code of jobs: one for each interpreter and list of requirements.
//!
//! The folder has a subfolder for each environment and a link to it, named by a hash. The link is
//! renamed into place when the environment is complete, so a build that was killed leaves only a
//! subfolder, which the next build removes. A locked file keeps builds of the same environment
//! apart, also those of other workers.

use std::{
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
    process::{Command, ExitStatus, Stdio},
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    thread,
    time::{Duration, Instant},
};

use picofarm_proto::show;
use picofarm_session::AgentError;
use picofarm_store::sha256_hex;
use serde_json::json;
use tracing::info;

use super::{channel::Event, process::Process};
use crate::{
    interpreter::Interpreter,
    task::{Control, TaskError},
};

/// The builder, written into the folder of each environment.
const BUILDER: &str = include_str!("../../../../python/picofarm/_environment.py");
/// Version of the builder and of the folder's form.
const FORM: &str = "environment-1";
/// Letters of an environment's name.
const NAME: usize = 32;
/// How long a build may take, including the wait for another one. PyTorch with CUDA is 3 GB.
const BUILD: Duration = Duration::from_secs(30 * 60);
/// How long output is read after the end of a build.
const LAST_OUTPUT: Duration = Duration::from_secs(2);
/// Interval at which locks, the end of the builder and requests to stop are looked for.
const LOOK: Duration = Duration::from_millis(50);
/// Most lines of output that wait for the worker.
const WAITING: usize = 64;

/// The interpreter for a task.
#[derive(Debug)]
pub(crate) struct Prepared {
    /// The interpreter, of an environment if one was needed.
    pub interpreter: Interpreter,
    /// Whether it belongs to an environment.
    pub built: bool,
    /// Variables for the code.
    pub variables: Vec<(String, String)>,
}

/// Creates the folder for environments.
///
/// # Errors
/// [`AgentError::Config`] if it cannot be created.
pub(crate) fn open_environments(folder: &Path) -> Result<PathBuf, AgentError> {
    let opened = fs::create_dir_all(folder).and_then(|()| folder.canonicalize());
    opened.map_err(|e| AgentError::Config {
        field: "python-environments",
        what: format!("{}: {e}; name a folder on a local disk", folder.display()),
    })
}

/// Returns the interpreter for a task: the worker's, or that of an environment with the
/// requirements, which is built if this machine does not have it yet.
///
/// # Errors
/// [`TaskError::Crash`] if the requirements cannot be installed; [`TaskError::Interrupted`] if the
/// folder cannot be used or the time is up; [`TaskError::Stopped`] if the worker stops.
pub(crate) fn prepare(
    (interpreter, folder): (&Interpreter, Option<&Path>),
    requirements: &[String],
    control: &Control,
) -> Result<Prepared, TaskError> {
    let Some(folder) = folder.filter(|_| !requirements.is_empty()) else {
        return Ok(Prepared {
            interpreter: interpreter.clone(),
            built: false,
            variables: Vec::new(),
        });
    };
    let environment = Environment::new((interpreter, folder), requirements);
    let found = match environment.found() {
        Some(found) => found,
        None => environment.build((control, Instant::now() + BUILD))?,
    };
    let variables = variables(found.path());
    Ok(Prepared {
        interpreter: found,
        built: true,
        variables,
    })
}

/// Returns the variables by which programs of the environment are found first.
fn variables(python: &Path) -> Vec<(String, String)> {
    let programs = python.parent().unwrap_or(python);
    let mut path = programs.display().to_string();
    if let Ok(inherited) = std::env::var("PATH") {
        path = format!("{path}:{inherited}");
    }
    let root = programs.parent().unwrap_or(programs).display().to_string();
    vec![("PATH".into(), path), ("VIRTUAL_ENV".into(), root)]
}

/// An environment, whether it exists or not.
struct Environment<'a> {
    interpreter: &'a Interpreter,
    /// Folder of all environments.
    folder: &'a Path,
    name: String,
    requirements: Vec<&'a str>,
    /// Variables of the builder, which override the worker's.
    variables: Vec<(&'static str, String)>,
}

impl<'a> Environment<'a> {
    fn new((interpreter, folder): (&'a Interpreter, &'a Path), requirements: &'a [String]) -> Self {
        let mut requirements: Vec<&str> = requirements.iter().map(String::as_str).collect();
        requirements.sort_unstable();
        requirements.dedup();
        let pinned = json!([FORM, interpreter.build(), requirements]).to_string();
        let mut name = sha256_hex(pinned.as_bytes());
        name.truncate(NAME);
        Self {
            interpreter,
            folder,
            name,
            requirements,
            variables: Vec::new(),
        }
    }

    /// Returns the interpreter of the environment if it is complete and starts.
    fn found(&self) -> Option<Interpreter> {
        let folder = self.folder.join(&self.name).canonicalize().ok()?;
        let found = Interpreter::find(&folder.join("venv/bin/python")).ok()?;
        (found.build() == self.interpreter.build()).then_some(found)
    }

    /// Builds the environment, unless another worker does so first.
    fn build(&self, (control, until): (&Control, Instant)) -> Result<Interpreter, TaskError> {
        let failed = |e: io::Error| {
            TaskError::Interrupted(format!(
                "cannot build an environment in {}: {e}; make room there, or name another folder (--python-environments)",
                self.folder.display()
            ))
        };
        let _lock = self.lock((control, until))?;
        if let Some(found) = self.found() {
            return Ok(found);
        }
        self.remove_remains().map_err(failed)?;
        let prefix = format!("{}-", self.name);
        let mut builder = tempfile::Builder::new();
        let made = builder.prefix(&prefix).tempdir_in(self.folder);
        let folder = made.map_err(failed)?;
        info!("installs {}", show::line(&self.requirements.join(", ")));
        self.install(folder.path(), (control, until))?;
        self.publish(folder.path()).map_err(failed)?;
        let _ = folder.keep();
        self.found().ok_or_else(|| {
            TaskError::Crash(format!(
                "python.requirements: the Python of {} does not start; delete the folder, and start the worker with another \
                 Python",
                self.folder.join(&self.name).display()
            ))
        })
    }

    /// Waits until no other worker builds this environment.
    fn lock(&self, (control, until): (&Control, Instant)) -> Result<File, TaskError> {
        let path = self.folder.join(format!("{}.lock", self.name));
        let failed = |e: io::Error| {
            let shown = path.display();
            TaskError::Interrupted(format!("cannot lock {shown}: {e}; name a local folder"))
        };
        let file = File::create(&path).map_err(failed)?;
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(file),
                Err(TryLockError::Error(e)) => return Err(failed(e)),
                Err(TryLockError::WouldBlock) => self.go_on((control, until))?,
            }
            thread::sleep(LOOK);
        }
    }

    /// Continues unless the worker stops or the time is up.
    fn go_on(&self, (control, until): (&Control, Instant)) -> Result<(), TaskError> {
        if control.stopped() {
            return Err(TaskError::Stopped);
        }
        match Instant::now() < until {
            true => Ok(()),
            false => Err(TaskError::Interrupted(format!(
                "python.requirements: {} were not installed within {} minutes; use a nearer index, or start a worker whose \
                 Python has them",
                show::line(&self.requirements.join(", ")),
                BUILD.as_secs() / 60
            ))),
        }
    }

    /// Removes what builds have left that were killed, and an environment that does not start.
    fn remove_remains(&self) -> io::Result<()> {
        let ours = format!("{}-", self.name);
        for entry in fs::read_dir(self.folder)? {
            let entry = entry?;
            if entry.file_name().to_string_lossy().starts_with(&ours) {
                fs::remove_dir_all(entry.path())?;
            }
        }
        Ok(())
    }

    /// Installs the requirements below `folder`.
    fn install(
        &self,
        folder: &Path,
        (control, until): (&Control, Instant),
    ) -> Result<(), TaskError> {
        let failed = |e: io::Error| super::unprepared(folder, &e);
        let requirements = self.requirements.join("\n") + "\n";
        fs::write(folder.join("requirements.txt"), requirements).map_err(failed)?;
        fs::write(folder.join("build.py"), BUILDER).map_err(failed)?;
        let (sender, heard) = sync_channel(WAITING);
        let mut command = Command::new(self.interpreter.path());
        command
            .args(["-I", "build.py", "venv", "requirements.txt"])
            .envs(self.variables.iter().map(|(name, value)| (name, value)))
            // The builder ends when this worker's end of the pipe is closed.
            .stdin(Stdio::piped());
        let mut process = Process::start(command, folder, &sender).map_err(failed)?;
        drop(sender);
        let status = loop {
            self.go_on((control, until))?;
            listen(&heard, &mut process, Instant::now() + LOOK);
            if let Some(status) = process.ended().map_err(failed)? {
                break status;
            }
        };
        listen(&heard, &mut process, Instant::now() + LAST_OUTPUT);
        match status.success() {
            true => Ok(()),
            false => Err(self.failure(status, &process)),
        }
    }

    fn failure(&self, status: ExitStatus, process: &Process) -> TaskError {
        TaskError::Crash(format!(
            "python.requirements: {} cannot be installed ({status}): {}; correct them, or the index of this worker's pip or uv",
            show::line(&self.requirements.join(", ")),
            show::line(&process.last_lines())
        ))
    }

    /// Renames the link to a finished environment into place.
    fn publish(&self, folder: &Path) -> io::Result<()> {
        fs::remove_dir_all(folder.join("tmp"))?;
        // A machine that stops now must not leave a link to half of the files.
        #[cfg(target_os = "linux")]
        rustix::fs::syncfs(File::open(folder)?)?;
        let link = folder.with_extension("link");
        std::os::unix::fs::symlink(folder.file_name().unwrap_or_default(), &link)?;
        fs::rename(link, self.folder.join(&self.name))
    }
}

/// Hears output until a time, or until there is no more.
fn listen(heard: &Receiver<Event>, process: &mut Process, until: Instant) {
    loop {
        let left = until.saturating_duration_since(Instant::now());
        match heard.recv_timeout(left) {
            Ok(Event::Output(line)) => {
                info!("{}", show::line(line.trim_end()));
                process.said(&line);
            }
            Ok(_) => {}
            Err(RecvTimeoutError::Timeout) => return,
            Err(RecvTimeoutError::Disconnected) => {
                thread::sleep(left.min(LOOK));
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests;
