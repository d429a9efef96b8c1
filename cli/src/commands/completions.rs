//! `picofarm completions` and `picofarm man`: a shell's completion script, and manual pages.

use std::path::Path;

use clap_complete::Shell;
use serde_json::json;

use crate::{
    args,
    error::{Result, io},
    output::{self, Output},
};

/// Prints the completion script of a shell.
pub fn print(shell: Shell) {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut args::command(), "picofarm", &mut script);
    output::print(&script);
}

/// Writes a manual page for each command to a folder.
///
/// # Errors
/// Fails if the folder cannot be created or written.
pub fn manual(folder: &Path, output: Output) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| io(folder.display(), &e))?;
    clap_mangen::generate_to(args::command(), folder).map_err(|e| io(folder.display(), &e))?;
    output.result(&json!({"folder": folder}), || {
        format!("manual pages are in {}\n", folder.display())
    });
    Ok(())
}
