//! The `picofarm` program. What it is built with are this package's features; all it does is in `picofarm-cli`.

use std::process::ExitCode;

/// The system's allocator gives pages back that the next tensor of that size fetches again: with this one, a small network's
/// step on the CPU takes 0.81 to 0.98 of the time (docs/models.md), and renders as long as before.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// The allocator's `mi_option_purge_delay`, which its binding has no name for.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

/// Free memory goes back to the system after ten seconds and not after one: what a training step frees, the next one takes again,
/// and fresh pages have to be cleared first (up to an eighth of a step's time). `MIMALLOC_PURGE_DELAY` says otherwise, in
/// milliseconds.
#[expect(unsafe_code, reason = "an allocator's setting; proof below")]
fn keep_free_memory() {
    // SAFETY: the option is one of this version's (mimalloc.h, `mi_option_e`), and there is no other thread yet.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, 10_000) }
}

fn main() -> ExitCode {
    keep_free_memory();
    #[cfg(feature = "bench")]
    let bench: Option<picofarm_cli::Bench> =
        Some(|command, settings, output| Box::pin(picofarm_perf::run(command, settings, output)));
    #[cfg(not(feature = "bench"))]
    let bench = None;
    picofarm_cli::run_program(bench)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[expect(unsafe_code, reason = "as above")]
    fn the_option_is_the_delay_and_the_environment_goes_before() {
        // SAFETY: the option is one of this version's, and no other test of this binary touches it.
        let delay = || unsafe { libmimalloc_sys::mi_option_get(PURGE_DELAY) };
        let said = std::env::var("MIMALLOC_PURGE_DELAY").ok();
        let said = said.and_then(|delay| delay.parse().ok());
        // The version's own: another number here is another option.
        assert_eq!(delay(), said.unwrap_or(1000));
        keep_free_memory();
        assert_eq!(delay(), said.unwrap_or(10_000));
    }
}
