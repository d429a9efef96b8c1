//! The conversation with a Python process, from its start to its end.

use std::{
    os::unix::process::ExitStatusExt,
    path::{Path, PathBuf},
    process::{Command, ExitStatus, Stdio},
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    time::{Duration, Instant},
};

use picofarm_proto::show;
use serde_json::{Value, json};
use tracing::info;

use super::{
    Answer, Ended, Host, Interpreter, Patience,
    channel::{Channel, Event},
    message::{self, Done, Message},
    process::Process,
    unprepared,
};
use crate::task::{Control, TaskError};

/// Interval at which connections, the end of the process and requests to stop are looked for.
const LOOK: Duration = Duration::from_millis(20);
/// How long output is read after the end of the process.
const LAST_OUTPUT: Duration = Duration::from_secs(2);
/// Most messages that wait for the worker. Further ones make the process wait.
const WAITING: usize = 64;
/// Exit status of a task whose requirements are not installed, from `_runner.py`.
const UNMET: i32 = 78;
/// The reason for a stop that was given before.
const PRUNED: &str = "pruned";
/// The reason for a stop that the worker wants.
const WORKER_STOPS: &str = "worker stops";

/// Starts the runner in `folder` and serves it to its end.
pub(super) fn serve(
    interpreter: &Interpreter,
    (folder, variables): (&Path, &[(String, String)]),
    host: &mut dyn Host,
    (control, patience): (&Control, Patience),
) -> Result<Ended, TaskError> {
    let (sender, heard) = sync_channel(WAITING);
    let failed = |e: std::io::Error| unprepared(folder, &e);
    let channel = Channel::open(folder, sender.clone()).map_err(failed)?;
    let mut command = Command::new(interpreter.path());
    command
        .arg(folder.join("runner.py"))
        .env("PICOFARM_RUN", folder)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .env("OMP_NUM_THREADS", rayon::current_num_threads().to_string())
        .envs(variables.iter().map(|(name, value)| (name, value)))
        .stdin(Stdio::null());
    let process = Process::start(command, folder, &sender).map_err(failed)?;
    drop(sender);
    let mut session = Session {
        folder: folder.canonicalize().map_err(failed)?,
        channel,
        process,
        heard,
        host,
        control,
        patience,
        stop: None,
        terminated: None,
        told: false,
        pruned: false,
        done: None,
        outputs: 2,
    };
    let ended = session.converse();
    session.channel.close();
    session.process.kill();
    ended
}

struct Session<'a> {
    /// Folder of the task, without links.
    folder: PathBuf,
    channel: Channel,
    process: Process,
    heard: Receiver<Event>,
    host: &'a mut dyn Host,
    control: &'a Control,
    patience: Patience,
    /// Time at which the request to stop was noticed.
    stop: Option<Instant>,
    /// Time of SIGTERM.
    terminated: Option<Instant>,
    /// Whether the process knows that the worker stops.
    told: bool,
    /// Whether the host has ended the training.
    pruned: bool,
    done: Option<Done>,
    /// Number of outputs that are still open.
    outputs: u32,
}

impl Session<'_> {
    fn converse(&mut self) -> Result<Ended, TaskError> {
        let lost = |e: std::io::Error| {
            TaskError::Interrupted(format!("the Python process cannot be followed: {e}"))
        };
        loop {
            self.channel.accept().map_err(lost)?;
            if let Some(ended) = self.hurry()? {
                return Ok(ended);
            }
            match self.heard.recv_timeout(LOOK) {
                Ok(event) => self.hear(event)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => std::thread::sleep(LOOK),
            }
            if let Some(status) = self.process.ended().map_err(lost)? {
                return self.ended(status);
            }
        }
    }

    /// Ends a process that does not follow the request to stop. Returns its end if it is over.
    fn hurry(&mut self) -> Result<Option<Ended>, TaskError> {
        if !self.control.stopped() && !self.pruned {
            return Ok(None);
        }
        if self.control.unwanted() {
            return Err(TaskError::Stopped);
        }
        let since = *self.stop.get_or_insert_with(Instant::now);
        match self.terminated {
            Some(at) if at.elapsed() >= self.patience.terminate => {
                info!("the code did not end; its process is killed");
                match self.pruned {
                    true => Ok(Some(Ended::Stopped)),
                    false => Err(TaskError::Stopped),
                }
            }
            None if since.elapsed() >= self.patience.stop => {
                info!("the code did not end within {:?}", self.patience.stop);
                self.process.terminate();
                self.terminated = Some(Instant::now());
                Ok(None)
            }
            _ => Ok(None),
        }
    }

    fn hear(&mut self, event: Event) -> Result<(), TaskError> {
        match event {
            Event::Output(line) => {
                info!("{}", show::line(line.trim_end()));
                self.process.said(&line);
            }
            Event::Closed(number) => self.channel.forget(number),
            Event::OutputEnded => self.outputs = self.outputs.saturating_sub(1),
            Event::Flood => {
                let most = message::MESSAGE_BYTES >> 20;
                let what = format!("python: a message has more than {most} MiB");
                return Err(TaskError::User(what));
            }
            Event::Message(number, line) => {
                let message = message::read(&line)
                    .map_err(|what| TaskError::User(format!("python: {what}")))?;
                let answer = match self.follow(message) {
                    Ok(answer) => answer,
                    Err(TaskError::User(what)) => json!({"error": what}),
                    Err(other) => return Err(other),
                };
                self.channel.answer(number, &answer);
            }
        }
        Ok(())
    }

    /// Does what a message asks for, and returns the answer.
    fn follow(&mut self, message: Message) -> Result<Value, TaskError> {
        match message {
            Message::Report(report) => {
                report.check().map_err(TaskError::User)?;
                if self.pruned {
                    return Ok(json!({"stop": PRUNED}));
                }
                if let Answer::Stop(why) = self.host.report(report)? {
                    self.pruned = true;
                    return Ok(json!({"stop": why}));
                }
                Ok(self.go_on(false))
            }
            Message::Checkpoint { step, path } => {
                let file = self.own_file("checkpoint", &path)?;
                self.host.checkpoint(step, &file)?;
                Ok(self.go_on(true))
            }
            Message::Artifact { name, path } => {
                message::check_name("artifact", &name).map_err(TaskError::User)?;
                let file = self.own_file("artifact", &path)?;
                self.host.artifact(&name, &file)?;
                Ok(self.go_on(false))
            }
            Message::Progress(share) => {
                self.control.at(share);
                Ok(self.go_on(false))
            }
            Message::Poll {} if self.control.stopped() => {
                self.told = true;
                Ok(json!({"go": true, "stopping": WORKER_STOPS}))
            }
            Message::Poll {} => Ok(json!({"go": true})),
            Message::Done(done) => {
                self.done = Some(done);
                Ok(json!({"go": true}))
            }
        }
    }

    /// Returns the answer if the host has no objection. The code is told once that the worker
    /// stops, so that it can save a checkpoint, and then it is stopped.
    fn go_on(&mut self, saved: bool) -> Value {
        if !self.control.stopped() {
            return json!({"go": true});
        }
        if saved || self.told {
            return json!({"stop": WORKER_STOPS});
        }
        self.told = true;
        json!({"go": true, "stopping": WORKER_STOPS})
    }

    /// Returns the path of a file that the process has written into its folder.
    fn own_file(&self, what: &str, path: &Path) -> Result<PathBuf, TaskError> {
        let refuse = |why: &str| {
            TaskError::User(format!(
                "{what}: {} {why}; leave the file to picofarm.run",
                path.display()
            ))
        };
        let found = path.canonicalize().map_err(|e| refuse(&e.to_string()))?;
        if !found.starts_with(&self.folder) {
            return Err(refuse("is outside of the task's folder"));
        }
        match found.is_file() {
            true => Ok(found),
            false => Err(refuse("is no file")),
        }
    }

    /// Hears the rest, and returns the outcome of a process that has ended.
    fn ended(&mut self, status: ExitStatus) -> Result<Ended, TaskError> {
        let until = Instant::now() + LAST_OUTPUT;
        while self.outputs > 0 && Instant::now() < until {
            match self.heard.recv_timeout(LOOK) {
                // Nobody waits for the answers any more.
                Ok(Event::Message(..) | Event::Flood) | Err(RecvTimeoutError::Timeout) => {}
                Ok(event) => self.hear(event)?,
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        if self.pruned {
            return Ok(Ended::Stopped);
        }
        match self.done.take() {
            Some(Done {
                stopped: Some(_), ..
            }) => Err(TaskError::Stopped),
            Some(Done { result, facts, .. }) => Ok(Ended::Done { result, facts }),
            None if self.control.stopped() => Err(TaskError::Stopped),
            None => Err(self.failure(status)),
        }
    }

    fn failure(&self, status: ExitStatus) -> TaskError {
        let last = self.process.last_lines();
        // The supervisor passes a signal on as a shell does.
        let code = status.code().unwrap_or(0);
        let signal = status.signal().or((code > 128).then(|| code - 128));
        match (signal, code) {
            (Some(signal), _) => TaskError::Crash(format!(
                "python: signal {signal} ended the process (9 may mean that memory ran out); its last lines: {last}"
            )),
            (None, UNMET) => TaskError::Crash(format!(
                "python: {last}; install it in the interpreter of this worker, start the worker with --python-environments DIR, or \
                 correct python.requirements"
            )),
            (None, 0) => TaskError::User(format!(
                "python: the process ended without a result, e.g. by os._exit; its last lines: {last}"
            )),
            (None, code) => {
                TaskError::User(format!("python: the code failed (status {code}): {last}"))
            }
        }
    }
}
