//! The command that `picofarm events --follow --run COMMAND` runs for events.

use std::{
    io::Write,
    path::PathBuf,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use picofarm_proto::{messages::Event, show};

use crate::{
    error::{CliError, Result, io},
    files,
    output::Output,
};

/// The time that a command may take.
const LONGEST: Duration = Duration::from_secs(60);
const PAUSE: Duration = Duration::from_millis(20);

/// The kinds of events, but for lines that tasks log.
const KINDS: [&str; 16] = [
    "submitted",
    "leased",
    "committed",
    "reused",
    "failed",
    "dead",
    "expired",
    "released",
    "cancelled",
    "retried",
    "ended",
    "waiting",
    "alarm",
    "opened",
    "paused",
    "resumed",
];

fn name(event: &Event) -> String {
    match serde_json::to_value(event.kind) {
        Ok(serde_json::Value::String(name)) => name,
        _ => unreachable!("kinds are written as names"),
    }
}

/// A shell command for events of some kinds.
pub struct Hook {
    command: String,
    kinds: Vec<String>,
    cursor: Option<PathBuf>,
}

impl Hook {
    /// # Errors
    /// Names an unknown kind.
    pub fn new(command: String, kinds: Vec<String>, cursor: Option<PathBuf>) -> Result<Self> {
        if let Some(kind) = kinds.iter().find(|kind| !KINDS.contains(&kind.as_str())) {
            let what = format!("--kinds: {}", show::unknown(kind, &KINDS));
            return Err(CliError::input(what));
        }
        Ok(Self {
            command,
            kinds,
            cursor,
        })
    }

    /// Returns the last event that was handled before, if a file keeps it.
    ///
    /// # Errors
    /// Names a cursor file that cannot be read or has no number.
    pub fn start(&self) -> Result<Option<u64>> {
        let Some(path) = self.cursor.as_ref().filter(|path| path.exists()) else {
            return Ok(None);
        };
        let text = files::read_text(path, 64)?;
        text.trim().parse().map(Some).map_err(|_| {
            let what = "expected the number of an event, as --cursor writes it";
            CliError::input(format!("{}: {what}", path.display()))
        })
    }

    /// Runs the command for an event if it has one of the kinds, and keeps the event's number. A
    /// command that fails is a warning.
    ///
    /// # Errors
    /// Fails if the shell cannot be started or the cursor cannot be written.
    pub fn handle(&self, event: &Event, output: Output) -> Result<()> {
        let name = name(event);
        if self.kinds.contains(&name) {
            self.run(&name, event, output)?;
        }
        self.keep(event.sequence)
    }

    /// Keeps the number of the last event that was handled.
    ///
    /// # Errors
    /// Fails if the cursor cannot be written.
    pub fn keep(&self, sequence: u64) -> Result<()> {
        let Some(path) = &self.cursor else {
            return Ok(());
        };
        let partial = path.with_extension("partial");
        std::fs::write(&partial, format!("{sequence}\n"))
            .and_then(|()| std::fs::rename(&partial, path))
            .map_err(|e| io(path.display(), &e))
    }

    fn run(&self, name: &str, event: &Event, output: Output) -> Result<()> {
        let failed = |e: std::io::Error| CliError::input(format!("--run: cannot start sh: {e}"));
        let mut child = Command::new("sh")
            .args(["-c", &self.command])
            .env("PICOFARM_JOB", event.job.to_string())
            .env("PICOFARM_EVENT", name)
            .env("PICOFARM_MESSAGE", &event.message)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .map_err(failed)?;
        if let Some(mut stdin) = child.stdin.take() {
            // A command that does not read its input is no error.
            let _ = writeln!(stdin, "{}", serde_json::json!(event));
        }
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = child.try_wait().map_err(failed)? {
                break status;
            }
            if begun.elapsed() > LONGEST {
                let _ = child.kill();
                child.wait().map_err(failed)?;
                let s = LONGEST.as_secs();
                output.warn(format!(
                    "--run: the command took more than {s} s and was ended"
                ));
                return Ok(());
            }
            std::thread::sleep(PAUSE);
        };
        if !status.success() {
            output.warn(format!(
                "--run: the command ended with {status} for {name} of {}",
                event.job
            ));
        }
        Ok(())
    }
}
