//! SIGINT and SIGTERM: the first asks for an orderly end, the second ends the process at once. A SIGTERM right after
//! another is the same one: schedulers send it to the process and to its group.

use std::time::{Duration, Instant};

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::error::{CliError, Code, Result};

/// SIGTERMs within this time are one.
const ONE: Duration = Duration::from_secs(2);

/// A token that the first signal cancels.
///
/// # Errors
/// The system refuses a signal handler.
pub fn stop_on_signal() -> Result<CancellationToken> {
    let refused =
        |e: std::io::Error| CliError::new(Code::Failed, format!("cannot listen for signals: {e}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(refused)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(refused)?;
    let token = CancellationToken::new();
    let stop = token.clone();
    tokio::spawn(async move {
        let mut first: Option<Instant> = None;
        loop {
            let same = tokio::select! {
                _ = interrupt.recv() => false,
                _ = terminate.recv() => first.is_some_and(|at| at.elapsed() < ONE),
            };
            match first {
                None => {
                    first = Some(Instant::now());
                    eprintln!("stopping; finished work is kept (a second signal ends at once)");
                    stop.cancel();
                }
                Some(_) if same => {}
                Some(_) => std::process::exit(130),
            }
        }
    });
    Ok(token)
}

/// The exit of a command that a signal ended.
pub fn interrupted(hint: &str) -> CliError {
    CliError::new(Code::Interrupted, "interrupted").hint(hint)
}
