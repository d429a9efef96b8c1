//! A process that an interpreter runs.

use std::{
    collections::VecDeque,
    io,
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc::SyncSender,
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Pid, Signal, kill_process_group};

use super::channel::{Event, read_output};

/// How long the supervisor may take to end its processes once its connection is closed.
const SUPERVISED_END: Duration = Duration::from_secs(5);
/// Interval at which the end of a process is looked for.
const LOOK: Duration = Duration::from_millis(10);
/// Number of lines of output that an error repeats.
const LAST_LINES: usize = 12;
/// Variables of the worker that its code has no use for, and must not read: its credentials.
const OURS: &str = "PICOFARM_";

/// A running process, which leads a group.
pub(super) struct Process {
    child: Child,
    ended: Option<ExitStatus>,
    last: VecDeque<String>,
}

impl Process {
    /// Starts a program in a folder, without the worker's credentials.
    pub(super) fn start(
        mut command: Command,
        folder: &Path,
        sender: &SyncSender<Event>,
    ) -> io::Result<Self> {
        use std::os::unix::process::CommandExt;
        let ours = |name: &std::ffi::OsStr| name.to_string_lossy().starts_with(OURS);
        let given = |name: &std::ffi::OsStr| command.get_envs().any(|(known, _)| known == name);
        let inherited = std::env::vars_os().map(|(name, _)| name);
        let hidden: Vec<_> = inherited
            .filter(|name| ours(name) && !given(name))
            .collect();
        for name in hidden {
            command.env_remove(name);
        }
        // Files that a killed process leaves, such as those of torchrun, go with the folder.
        let temporary = folder.join("tmp");
        std::fs::create_dir_all(&temporary)?;
        let mut child = command
            .env("TMPDIR", temporary)
            .env("PYTHONUNBUFFERED", "1")
            .current_dir(folder)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()?;
        let outputs = (child.stdout.take(), child.stderr.take());
        let process = Self {
            child,
            ended: None,
            last: VecDeque::new(),
        };
        if let (Some(out), Some(err)) = outputs {
            read_output(out, sender.clone())?;
            read_output(err, sender.clone())?;
        }
        Ok(process)
    }

    /// Remembers a line of output.
    pub(super) fn said(&mut self, line: &str) {
        if self.last.len() == LAST_LINES {
            self.last.pop_front();
        }
        self.last.push_back(line.to_owned());
    }

    /// Returns the last lines of output, as a part of an error.
    pub(super) fn last_lines(&self) -> String {
        let lines = self.last.iter().map(|line| line.trim_end());
        let lines: Vec<&str> = lines.filter(|line| !line.is_empty()).collect();
        lines.join(" | ")
    }

    /// Returns how the process ended; `None` while it runs.
    pub(super) fn ended(&mut self) -> io::Result<Option<ExitStatus>> {
        if self.ended.is_none() {
            self.ended = self.child.try_wait()?;
        }
        Ok(self.ended)
    }

    /// Asks the group to end.
    pub(super) fn terminate(&self) {
        self.signal(Signal::TERM);
    }

    /// Ends the group. The connection to the supervisor was closed before, so that it can end the
    /// processes that have left the group.
    pub(super) fn kill(&mut self) {
        let until = Instant::now() + SUPERVISED_END;
        while matches!(self.ended(), Ok(None)) && Instant::now() < until {
            thread::sleep(LOOK);
        }
        self.signal(Signal::KILL);
        // A process that cannot be waited for is gone.
        let _ = self.child.wait();
    }

    /// Sends a signal to the group, as long as its number cannot belong to another.
    fn signal(&self, signal: Signal) {
        if self.ended.is_some() {
            return;
        }
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw);
        if let Some(pid) = pid {
            // The group may have ended in the meantime.
            let _ = kill_process_group(pid, signal);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.signal(Signal::KILL);
        let _ = self.child.wait();
    }
}
