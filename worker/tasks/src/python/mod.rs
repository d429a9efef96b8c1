//! Runs Python code for a task: a process of its own, which reports to the worker and asks whether
//! it must stop.
//!
//! The process gets a scratch folder with `task.json`, the code and a Unix socket. It sends one
//! JSON object a line and gets one as an answer ([`message`]). Its output becomes log lines of the
//! task.
//! The worker brings both sides of the conversation along: `_runner.py` and `run.py` are part of
//! this program, so that they fit whichever picofarm the interpreter has installed, or none.
//!
//! A worker with a folder for environments first installs what a stage requires ([`environment`]).
//!
//! The runner's first process supervises: when its connection closes, because the worker ended it
//! or died itself, it ends every process below it.

mod channel;
mod environment;
mod message;
mod process;
mod session;

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
    time::Duration,
};

use bytes::Bytes;
use serde_json::{Map, Value, json};
use tempfile::TempDir;

pub(crate) use environment::{open_environments, prepare};
pub(crate) use message::Report;

use crate::{
    interpreter::Interpreter,
    task::{Control, TaskError},
};

/// The supervisor, written into the folder of each task.
const RUNNER: &str = include_str!("../../../../python/picofarm/_runner.py");
/// The module `picofarm.run`, written into the folder of each task.
const RUN: &str = include_str!("../../../../python/picofarm/run.py");
/// Longest path of a Unix socket on all systems, in bytes.
const SOCKET_PATH: usize = 100;

/// What a process is asked to do.
#[derive(Debug, Default)]
pub(crate) struct Order<'a> {
    /// `module:function`, or `file.py` to run as a script.
    pub entry: String,
    /// Files of the code, by path below the code's folder.
    pub code: &'a [(String, Bytes)],
    /// Requirements (`name==version`) that the interpreter must have installed.
    pub requirements: &'a [String],
    /// Further members of `task.json`: `parameters`, `inputs`, `checkpoint_minutes`.
    pub task: Map<String, Value>,
    /// The checkpoint to resume from, as the process wrote it.
    pub checkpoint: Option<Vec<Bytes>>,
    /// Whether the interpreter belongs to an environment that was built for the requirements.
    pub built: bool,
    /// Variables of the process's environment.
    pub variables: Vec<(String, String)>,
}

/// The worker's side of the conversation.
pub(crate) trait Host {
    /// Hears metrics; returns whether the training goes on.
    ///
    /// # Errors
    /// [`TaskError::User`] is passed on to the code, other errors end the process.
    fn report(&mut self, report: Report) -> Result<Answer, TaskError>;

    /// Keeps a checkpoint. The file is the host's to move or delete.
    ///
    /// # Errors
    /// As [`Self::report`].
    fn checkpoint(&mut self, step: u64, file: &Path) -> Result<(), TaskError>;

    /// Keeps a file for publication. The file is the host's to move or delete.
    ///
    /// # Errors
    /// As [`Self::report`].
    fn artifact(&mut self, name: &str, file: &Path) -> Result<(), TaskError>;
}

/// The answer to a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Answer {
    /// The training goes on.
    Go,
    /// The training ends, for this reason.
    Stop(&'static str),
}

/// The end of a process that was not stopped by the worker.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Ended {
    /// The code came to its end.
    Done {
        /// What the code returned; null without it.
        result: Value,
        /// Interpreter, versions and host.
        facts: Value,
    },
    /// The code ended because the host answered [`Answer::Stop`].
    Stopped,
}

/// How long a process may take to end.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patience {
    /// From the request to stop until SIGTERM.
    pub stop: Duration,
    /// From SIGTERM until SIGKILL.
    pub terminate: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            stop: Duration::from_secs(120),
            terminate: Duration::from_secs(10),
        }
    }
}

/// Runs a process to its end, or until `control` stops it.
///
/// # Errors
/// [`TaskError::Stopped`] if the worker stopped it; [`TaskError::User`] with the last lines of its
/// output if the code failed or sent something that is no message; [`TaskError::Crash`] if a signal
/// ended it or a requirement is missing; [`TaskError::Interrupted`] if it cannot be started.
pub(crate) fn run(
    interpreter: &Interpreter,
    order: Order<'_>,
    host: &mut dyn Host,
    (control, patience): (&Control, Patience),
) -> Result<Ended, TaskError> {
    let folder = scratch()?;
    write(folder.path(), order, interpreter)
        .map_err(|e| unprepared(folder.path(), &e))
        .and_then(|variables| {
            session::serve(
                interpreter,
                (folder.path(), &variables),
                host,
                (control, patience),
            )
        })
}

/// Creates the folder of a task, with a path that is short enough for a socket.
fn scratch() -> Result<TempDir, TaskError> {
    let builder = || {
        let mut builder = tempfile::Builder::new();
        builder.prefix("picofarm-");
        builder
    };
    let usual = builder().tempdir();
    let made = match usual {
        Ok(folder) if folder.path().as_os_str().len() + "/socket".len() > SOCKET_PATH => {
            builder().tempdir_in("/tmp")
        }
        other => other,
    };
    made.map_err(|e| unprepared(&std::env::temp_dir(), &e))
}

fn unprepared(folder: &Path, error: &std::io::Error) -> TaskError {
    TaskError::Interrupted(format!(
        "cannot prepare a Python process in {}: {error}; make room there, or set TMPDIR",
        folder.display()
    ))
}

/// Writes everything that the process reads. Returns its variables.
fn write(
    folder: &Path,
    order: Order<'_>,
    interpreter: &Interpreter,
) -> std::io::Result<Vec<(String, String)>> {
    let code = folder.join("code");
    fs::create_dir(&code)?;
    fs::create_dir(folder.join("work"))?;
    for (name, bytes) in order.code {
        let path = code.join(name);
        fs::create_dir_all(path.parent().unwrap_or(&code))?;
        fs::write(path, bytes)?;
    }
    let checkpoint = match order.checkpoint {
        Some(pieces) => Some(join(folder.join("checkpoint"), &pieces)?),
        None => None,
    };
    let mut task = order.task;
    task.insert("entry".into(), json!(order.entry));
    task.insert("requirements".into(), json!(order.requirements));
    task.insert("environment".into(), json!(order.built));
    task.insert("checkpoint".into(), json!(checkpoint));
    task.insert("interpreter".into(), json!(interpreter.path()));
    fs::write(folder.join("task.json"), Value::Object(task).to_string())?;
    fs::write(folder.join("run.py"), RUN)?;
    fs::write(folder.join("runner.py"), RUNNER)?;
    Ok(order.variables)
}

/// Writes the pieces of a checkpoint into one file.
fn join(path: PathBuf, pieces: &[Bytes]) -> std::io::Result<PathBuf> {
    let mut file = File::create(&path)?;
    for piece in pieces {
        file.write_all(piece)?;
    }
    Ok(path)
}

#[cfg(test)]
mod tests;
