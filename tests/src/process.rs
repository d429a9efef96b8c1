//! A running process with its output in files: signals, waiting, and a guaranteed end.

use std::{
    fs::File,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::atomic::{AtomicU32, Ordering},
};

use crate::{cli::Ended, wait::until};

/// Signals for a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Signal {
    /// Ctrl-C.
    Interrupt,
    /// An orderly end.
    Terminate,
    /// A terminal that closes.
    Hangup,
    /// Freeze.
    Stop,
    /// Thaw.
    Continue,
}

/// A process. It ends on drop, by SIGKILL if necessary.
pub struct Process {
    child: Child,
    name: String,
    stdout: PathBuf,
    stderr: PathBuf,
}

impl Process {
    /// Starts `command`. Its output goes to `dir/NN-name.stdout` and `.stderr`.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(name: &str, mut command: Command, dir: &Path) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let file = |kind: &str| dir.join(format!("{number:02}-{name}.{kind}"));
        let (stdout, stderr) = (file("stdout"), file("stderr"));
        let child = command
            .stdin(Stdio::null())
            .stdout(File::create(&stdout).expect("the test's folder is writable"))
            .stderr(File::create(&stderr).expect("the test's folder is writable"))
            .spawn()
            .unwrap_or_else(|e| panic!("cannot start {name}: {e}"));
        Self {
            child,
            name: name.to_owned(),
            stdout,
            stderr,
        }
    }

    /// Returns its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns its stdout so far.
    pub fn stdout(&self) -> String {
        std::fs::read_to_string(&self.stdout).expect("the output was created at the start")
    }

    /// Returns its stderr so far.
    pub fn stderr(&self) -> String {
        std::fs::read_to_string(&self.stderr).expect("the output was created at the start")
    }

    /// Returns whether it still runs.
    ///
    /// # Panics
    /// If the system does not report it.
    pub fn runs(&mut self) -> bool {
        self.child
            .try_wait()
            .expect("a child can be waited for")
            .is_none()
    }

    /// Waits until its stderr contains `words`.
    ///
    /// # Panics
    /// If it ends before.
    pub fn until_says(&mut self, words: &str) {
        until(&format!("{} to say {words:?}", self.name), || {
            let runs = self.runs();
            let says = self.stderr().contains(words);
            assert!(says || runs, "{} ended: {}", self.name, self.stderr());
            says.then_some(())
        });
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// If the process has ended.
    pub fn signal(&mut self, signal: Signal) {
        assert!(self.runs(), "{} has ended: {}", self.name, self.stderr());
        let name = match signal {
            Signal::Interrupt => "INT",
            Signal::Terminate => "TERM",
            Signal::Hangup => "HUP",
            Signal::Stop => "STOP",
            Signal::Continue => "CONT",
        };
        // Uses the shell's builtin, because a signal is no reason for `unsafe`, and not every
        // system has /bin/kill.
        let sent = Command::new("sh")
            .args(["-c", &format!("kill -s {name} {}", self.child.id())])
            .status()
            .expect("there is a shell");
        assert!(sent.success(), "kill -s {name} {}", self.name);
    }

    /// Ends it at once, as `kill -9` does.
    ///
    /// # Panics
    /// If it had ended by itself, because then the test did not test the intended case.
    pub fn kill(mut self) {
        assert!(
            self.runs(),
            "{} has ended before its kill: {}",
            self.name,
            self.stderr()
        );
        self.child.kill().expect("a child can be killed");
        self.child.wait().expect("a child can be waited for");
    }

    /// Waits until it ends by itself.
    ///
    /// # Panics
    /// If it does not.
    pub fn end(mut self) -> Ended {
        let status = until(&format!("the end of {}", self.name), || {
            self.child.try_wait().expect("a child can be waited for")
        });
        Ended {
            what: self.name.clone(),
            code: status.code(),
            stdout: self.stdout(),
            stderr: self.stderr(),
        }
    }

    /// Waits for the first line of its stdout, and returns it.
    ///
    /// # Panics
    /// If it ends without one.
    pub fn first_line(&mut self) -> String {
        until(&format!("the first line of {}", self.name), || {
            let runs = self.runs();
            let text = self.stdout();
            let line = text.split_once('\n').map(|(line, _)| line.to_owned());
            assert!(
                line.is_some() || runs,
                "{} ended without a word: {}",
                self.name,
                self.stderr()
            );
            line
        })
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Both fail only if it has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
