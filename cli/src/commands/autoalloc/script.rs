//! The script of an allocation, which runs one worker.

use std::{fmt::Write, path::Path};

use picofarm_proto::show;

use crate::{
    args::{HAND_OVER, PoolArgs},
    error::{CliError, Result, io},
    settings::Settings,
};

/// Variables in which batch systems tell a job its id.
const IDS: &str = "${SLURM_JOB_ID:-${PBS_JOBID:-${LSB_JOBID:-${JOB_ID:-${PICOFARM_ALLOCATION:?\
                   the id of the allocation}}}}}";

/// Returns the script.
///
/// # Errors
/// Fails if the file of settings cannot be used, or if there is no way to pass the token on.
pub fn script(pool: &PoolArgs, settings: &Settings) -> Result<String> {
    let mut text = format!(
        "#!/usr/bin/env bash\n# A worker of the pool {}, submitted by `picofarm autoalloc`.\nset -euo pipefail\n",
        pool.pool
    );
    let mut line = |args: std::fmt::Arguments| writeln!(text, "{args}").expect("into a string");
    let quoted = |path: &Path| show::argument(&path.display().to_string()).to_string();
    match &pool.worker_env {
        Some(file) => {
            let file = checked(file)?;
            line(format_args!("set -a\n. {}\nset +a", quoted(&file)));
        }
        None => {
            if std::env::var_os("PICOFARM_TOKEN").is_some_and(|t| !t.is_empty()) {
                return Err(CliError::input(
                    "PICOFARM_TOKEN: a batch system keeps the scripts of its jobs, so the token is not written into one",
                )
                .hint("put it into a file that the nodes can read and give --token-file, or give --worker-env"));
            }
            let urls = show::argument(&settings.coordinator).to_string();
            line(format_args!("export PICOFARM_COORDINATOR={urls}"));
            for (name, path) in [
                ("CA", &settings.ca),
                ("CERT", &settings.cert),
                ("KEY", &settings.key),
                ("TOKEN_FILE", &settings.token_file),
                ("ASSETS", &Some(settings.assets.clone())),
            ] {
                let Some(path) = path else { continue };
                let path = std::path::absolute(path)
                    .map_err(|e| io(format_args!("{}", path.display()), &e))?;
                line(format_args!("export PICOFARM_{name}={}", quoted(&path)));
            }
        }
    }
    let program = crate::this_program().map_err(|e| io("this program", &e))?;
    let words = std::iter::once(program.get_program()).chain(program.get_args());
    let words: Vec<String> = words.map(|word| quoted(Path::new(word))).collect();
    line(format_args!("program=({})", words.join(" ")));
    line(format_args!(
        "if [ -n \"${{PICOFARM_BIN:-}}\" ]; then program=(\"$PICOFARM_BIN\"); fi"
    ));
    line(format_args!("id={IDS}"));
    line(format_args!("node=${{SLURMD_NODENAME:-$(uname -n)}}"));
    // The worker replaces the shell, so that signals reach it exactly once.
    let mut worker = format!(
        "exec \"${{program[@]}}\" worker --name \"{}$id@${{node%%.*}}\" --threads {} --memory-gib {} \
         --exit-idle-s {} --end-at {}s",
        prefix(&pool.pool),
        pool.cores,
        pool.memory_gib,
        pool.idle.as_secs(),
        pool.time_limit.saturating_sub(HAND_OVER).as_secs()
    );
    if pool.gpus > 0 {
        let _ = write!(worker, " --gpus {}", pool.gpus);
    }
    for label in &pool.label {
        let _ = write!(worker, " --label {}", show::argument(label));
    }
    line(format_args!("{worker}"));
    Ok(text)
}

/// Returns how the names of a pool's workers begin. The allocation's id and the node follow.
pub fn prefix(pool: &str) -> String {
    format!("{pool}-")
}

/// Checks a file of settings for workers and returns its absolute path.
fn checked(file: &Path) -> Result<std::path::PathBuf> {
    use std::os::unix::fs::PermissionsExt;
    let shown = file.display();
    let what = format!("--worker-env {shown}");
    let file = std::fs::canonicalize(file).map_err(|e| io(&what, &e))?;
    let mode = std::fs::metadata(&file).map_err(|e| io(&what, &e))?;
    let mode = mode.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        return Err(CliError::input(format!(
            "{what}: mode {mode:o} lets others read it, and it may contain keys"
        ))
        .hint(format!("chmod 600 {shown}")));
    }
    let text = std::fs::read_to_string(&file).map_err(|e| io(&what, &e))?;
    let sets = |name: &str| {
        text.lines()
            .filter_map(|line| line.trim().strip_prefix(name)?.strip_prefix('='))
            .any(|value| !value.is_empty())
    };
    if !sets("PICOFARM_COORDINATOR") {
        return Err(CliError::input(format!(
            "{what}: no PICOFARM_COORDINATOR=URL; a worker must know its coordinator"
        )));
    }
    if sets("PICOFARM_TOKEN") {
        return Err(CliError::input(format!(
            "{what}: PICOFARM_TOKEN is a secret that every process of the job would see"
        ))
        .hint("put the token into a file of its own and name that in PICOFARM_TOKEN_FILE"));
    }
    Ok(file)
}
