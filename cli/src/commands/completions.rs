//! `picofarm completions`: prints a shell's completion script.

use clap_complete::Shell;

use crate::{args, output};

/// Prints the completion script of a shell.
pub fn print(shell: Shell) {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut args::command(), "picofarm", &mut script);
    output::print(&script);
}
