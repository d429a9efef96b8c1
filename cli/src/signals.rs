//! SIGINT, SIGTERM and SIGHUP: the first signal asks for an orderly end, the second ends the
//! process at once. A SIGTERM shortly after another counts as the same, because schedulers send it
//! to the process and to its group. A SIGHUP never ends the process at once, because a closing
//! terminal may send it several times.

use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::{
    error::{CliError, Code, Result},
    output::tell,
};

/// Time within which several SIGTERMs count as one.
const ONE: Duration = Duration::from_secs(2);

/// Returns a token that the first signal cancels.
///
/// # Errors
/// Fails if the system refuses a signal handler.
pub fn stop_on_signal() -> Result<CancellationToken> {
    let refused =
        |e: std::io::Error| CliError::new(Code::Failed, format!("cannot listen for signals: {e}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(refused)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(refused)?;
    let mut hangup = hangups().map_err(refused)?;
    let token = CancellationToken::new();
    let stop = token.clone();
    tokio::spawn(async move {
        let mut first: Option<Instant> = None;
        loop {
            let same = tokio::select! {
                _ = interrupt.recv() => false,
                _ = terminate.recv() => first.is_some_and(|at| at.elapsed() < ONE),
                () = hangup.next() => true,
            };
            match first {
                None => {
                    first = Some(Instant::now());
                    stop.cancel();
                    tell("stopping; finished work is kept (a second signal ends at once)");
                }
                Some(_) if same => {}
                Some(_) => std::process::exit(130),
            }
        }
    });
    Ok(token)
}

/// SIGHUPs, unless the process was started to ignore them, as `nohup` does.
pub struct Hangups(Option<Signal>);

/// Listens for SIGHUP.
///
/// # Errors
/// Fails if the system refuses a signal handler.
pub fn hangups() -> std::io::Result<Hangups> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    match ignores_hangup(&status) {
        true => Ok(Hangups(None)),
        false => Ok(Hangups(Some(signal(SignalKind::hangup())?))),
    }
}

impl Hangups {
    /// Waits for the next SIGHUP.
    pub async fn next(&mut self) {
        match &mut self.0 {
            Some(signal) => {
                signal.recv().await;
            }
            None => std::future::pending().await,
        }
    }
}

/// Returns whether a process ignores SIGHUP, the first signal of the mask in `/proc/self/status`.
fn ignores_hangup(status: &str) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}

/// Returns the error of a command that a signal ended.
pub fn interrupted(hint: &str) -> CliError {
    CliError::new(Code::Interrupted, "interrupted").hint(hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_started_by_nohup_goes_on_ignoring_its_terminal() {
        assert!(ignores_hangup(
            "Name:\tx\nSigIgn:\t0000000000001001\nSigCgt:\t0\n"
        ));
        assert!(!ignores_hangup(
            "SigIgn:\t0000000000001000\nSigCgt:\t0000000000000001\n"
        ));
        assert!(!ignores_hangup(""));
    }
}
