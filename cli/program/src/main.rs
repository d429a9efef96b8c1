//! The `picofarm` program. This package's features select its parts; its code is in `picofarm-cli`.

use std::process::ExitCode;

/// The system's allocator returns pages that the next tensor of that size requests again. With
/// mimalloc, a training step of a small network on the CPU takes 0.81 to 0.98 of the time, and
/// renders take as long as before.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Text of `--version`: version, commit and features.
const VERSION: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    " (",
    env!("PICOFARM_COMMIT"),
    ")\nfeatures: ",
    env!("PICOFARM_FEATURES"),
);

fn main() -> ExitCode {
    picofarm_cli::run_program(VERSION)
}
