//! SIGINT and SIGTERM: the first asks for an orderly end, the second ends the process at once.

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::error::{CliError, Code, Result};

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
        for count in 0.. {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            if count == 0 {
                eprintln!("stopping; finished work is kept (a second signal ends at once)");
                stop.cancel();
            } else {
                std::process::exit(130);
            }
        }
    });
    Ok(token)
}

/// The exit of a command that a signal ended.
pub fn interrupted(hint: &str) -> CliError {
    CliError::new(Code::Interrupted, "interrupted").hint(hint)
}
