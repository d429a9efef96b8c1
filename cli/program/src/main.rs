//! The `picofarm` program. What it is built with are this package's features; all it does is in `picofarm-cli`.

use std::process::ExitCode;

fn main() -> ExitCode {
    #[cfg(feature = "bench")]
    let bench: Option<picofarm_cli::Bench> =
        Some(|command, settings, output| Box::pin(picofarm_perf::run(command, settings, output)));
    #[cfg(not(feature = "bench"))]
    let bench = None;
    picofarm_cli::run_program(bench)
}
