//! The batch system: submits, lists and cancels allocations by its own commands.

use std::{process::Stdio, time::Duration};

use tokio::{io::AsyncWriteExt, process::Command};

use super::{command::Commands, decide::Allocation, slurm::Slurm};

/// Timeout of a command of the batch system.
const ANSWERS: Duration = Duration::from_secs(60);
/// Bytes of a command's error message that are shown.
const SHOWN: usize = 2_000;

/// What an allocation requests.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// Name of the allocations, by which they are found again.
    pub name: String,
    /// Name of the pool.
    pub pool: String,
    /// Cores.
    pub cores: usize,
    /// Memory, MiB.
    pub memory_mib: u64,
    /// Graphics processors.
    pub gpus: u32,
    /// Longest duration.
    pub time_limit: Duration,
    /// Script that runs the worker.
    pub script: String,
}

/// A batch system.
pub enum Scheduler {
    /// Slurm.
    Slurm(Slurm),
    /// Commands of the user.
    Commands(Commands),
}

impl Scheduler {
    /// Submits one allocation and returns its id.
    ///
    /// # Errors
    /// Returns the words of the batch system.
    pub async fn submit(&self, request: &Request) -> Result<String, String> {
        let (what, id) = match self {
            Self::Slurm(slurm) => ("sbatch", slurm.submit(request).await?),
            Self::Commands(commands) => ("--submit", commands.submit(request).await?),
        };
        let plain = |c: char| !c.is_whitespace() && !c.is_control();
        match id.trim() {
            "" => Err(format!("{what} printed no id of an allocation")),
            id if id.chars().all(plain) => Ok(id.to_owned()),
            id => Err(format!(
                "{what} printed {id:?}: expected the id of an allocation alone"
            )),
        }
    }

    /// Returns the pool's allocations that wait or run, in the order of their submission.
    ///
    /// # Errors
    /// Returns the words of the batch system, or the line that cannot be read.
    pub async fn list(&self, request: &Request) -> Result<Vec<Allocation>, String> {
        match self {
            Self::Slurm(slurm) => slurm.list(request).await,
            Self::Commands(commands) => commands.list(request).await,
        }
    }

    /// Cancels an allocation that waits.
    ///
    /// # Errors
    /// Returns the words of the batch system.
    pub async fn cancel(&self, request: &Request, id: &str) -> Result<(), String> {
        match self {
            Self::Slurm(slurm) => slurm.cancel(id).await,
            Self::Commands(commands) => commands.cancel(request, id).await,
        }
    }
}

/// Runs a command with this standard input and returns its standard output.
///
/// # Errors
/// Returns the command's words on standard error, or why it did not run.
pub async fn output_of(what: &str, mut command: Command, input: &str) -> Result<String, String> {
    command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true);
    let run = async {
        let mut child = command
            .spawn()
            .map_err(|e| format!("cannot run {what}: {e}"))?;
        let mut stdin = child.stdin.take().expect("it is piped");
        // A command that does not read its input closes it.
        let _ = stdin.write_all(input.as_bytes()).await;
        drop(stdin);
        let ended = child.wait_with_output().await;
        let ended = ended.map_err(|e| format!("{what}: {e}"))?;
        if ended.status.success() {
            return String::from_utf8(ended.stdout)
                .map_err(|_| format!("{what} printed bytes that are not UTF-8"));
        }
        let said = String::from_utf8_lossy(&ended.stderr);
        let said: String = said.trim().chars().take(SHOWN).collect();
        Err(match &*said {
            "" => format!("{what} failed ({})", ended.status),
            said => format!("{what} failed ({}): {said}", ended.status),
        })
    };
    match tokio::time::timeout(ANSWERS, run).await {
        Ok(done) => done,
        Err(_) => Err(format!("{what} did not end within {} s", ANSWERS.as_secs())),
    }
}
