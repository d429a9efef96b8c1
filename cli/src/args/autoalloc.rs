//! Arguments of `autoalloc`.

use std::{path::PathBuf, time::Duration};

use clap::{Args, Subcommand};

use super::ranges;

/// A worker ends this long before its allocation does, to hand its tasks over.
pub const HAND_OVER: Duration = Duration::from_secs(60);

const SLURM: &str = "\
Examples:
  picofarm autoalloc slurm --max-workers 50 --time-limit 1h --cores 8 --memory-gib 12 \\
    -- --partition=short
  picofarm autoalloc slurm --pool gpu --max-workers 4 --time-limit 8h --cores 8 \\
    --memory-gib 24 --gpus 1 -- --account=lab
  picofarm autoalloc slurm --max-workers 50 --time-limit 1h --cores 8 --memory-gib 12 \\
    --once --dry-run";

const COMMAND: &str = "\
Each command runs in a shell:
  --submit  reads the script of a worker from standard input, submits it as one allocation,
            and prints the allocation's id. The next --list must contain it.
  --list    prints a line for each allocation of the pool that waits or runs, oldest first:
            ID pending, or ID running SECONDS
  --cancel  ends the allocation $PICOFARM_ALLOCATION if it still waits

Their environment has PICOFARM_POOL (the name of the allocations), PICOFARM_CORES,
PICOFARM_MEMORY_MIB, PICOFARM_GPUS and PICOFARM_TIME_LIMIT_S to request. The script finds the id
of its allocation in SLURM_JOB_ID, PBS_JOBID, LSB_JOBID, JOB_ID or PICOFARM_ALLOCATION.

Example (PBS):
  picofarm autoalloc command --max-workers 20 --time-limit 2h --cores 8 --memory-gib 12 \\
    --submit ./submit-pbs.sh --list ./list-pbs.sh --cancel 'qdel $PICOFARM_ALLOCATION'
where submit-pbs.sh is
  exec qsub -N $PICOFARM_POOL -l walltime=$PICOFARM_TIME_LIMIT_S \\
    -l select=1:ncpus=$PICOFARM_CORES:mem=${PICOFARM_MEMORY_MIB}mb";

/// Starts workers by a batch system when tasks wait.
#[derive(Subcommand)]
pub enum Autoalloc {
    /// Start workers on Slurm, with sbatch, squeue and scancel
    #[command(after_help = SLURM)]
    Slurm {
        #[command(flatten)]
        pool: PoolArgs,
        /// More options for sbatch, e.g. --partition=short --account=lab
        #[arg(last = true, value_name = "SBATCH_OPTION")]
        sbatch: Vec<String>,
    },
    /// Start workers on another batch system or cloud, with three commands of yours
    #[command(after_help = COMMAND)]
    Command {
        #[command(flatten)]
        pool: PoolArgs,
        /// Shell command that submits one worker
        #[arg(long, value_name = "COMMAND")]
        submit: String,
        /// Shell command that lists the pool's allocations
        #[arg(long, value_name = "COMMAND")]
        list: String,
        /// Shell command that cancels a waiting allocation
        #[arg(long, value_name = "COMMAND")]
        cancel: String,
    },
}

/// A pool of equal workers.
#[derive(Args, Clone)]
pub struct PoolArgs {
    /// Name of the pool: lower-case letters, digits and hyphens. Allocations and workers carry it
    #[arg(long, default_value = "pool", value_parser = pool_name)]
    pub pool: String,
    /// Most allocations that wait or run at once
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub max_workers: u32,
    /// How long an allocation may run, e.g. 1h. Its worker ends a minute before
    #[arg(long, value_name = "DURATION", value_parser = time_limit)]
    pub time_limit: Duration,
    /// Cores of a worker
    #[arg(long, value_name = "N", value_parser = ranges::threads)]
    pub cores: usize,
    /// Memory of a worker for tasks, GiB. The allocation requests a third more
    #[arg(long, value_name = "GIB", value_parser = ranges::gib)]
    pub memory_gib: f64,
    /// Graphics processors of a worker
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=64))]
    pub gpus: u32,
    /// Label of the workers that a stage can require; may be repeated
    #[arg(long, value_name = "LABEL")]
    pub label: Vec<String>,
    /// A worker without work for this long ends, and its allocation with it
    #[arg(long, default_value = "5m", value_name = "DURATION", value_parser = duration)]
    pub idle: Duration,
    /// Waiting work that justifies one more worker. Tasks of unknown duration justify one each
    #[arg(long, default_value = "1m", value_name = "DURATION", value_parser = positive)]
    pub work_per_worker: Duration,
    /// Most allocations that wait in the batch system's queue at once
    #[arg(long, default_value_t = 10, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub backlog: u32,
    /// File of settings for the workers, like deploy/worker.env.example [default: this command's
    /// coordinator, certificates and token file]
    #[arg(long, value_name = "FILE")]
    pub worker_env: Option<PathBuf>,
    /// Time between two decisions
    #[arg(long, default_value = "5s", value_name = "DURATION", value_parser = positive)]
    pub every: Duration,
    /// Decide once and exit, for cron
    #[arg(long)]
    pub once: bool,
    /// Print the decisions, but submit and cancel nothing
    #[arg(long)]
    pub dry_run: bool,
}

fn duration(text: &str) -> Result<Duration, String> {
    humantime::parse_duration(text).map_err(|_| "expected a duration such as 90s or 1h 30m".into())
}

fn positive(text: &str) -> Result<Duration, String> {
    match duration(text)? {
        long if long >= Duration::from_secs(1) => Ok(long),
        _ => Err("expected at least 1s".into()),
    }
}

fn time_limit(text: &str) -> Result<Duration, String> {
    match duration(text)? {
        long if long >= 2 * HAND_OVER => Ok(long),
        _ => Err(format!(
            "expected at least {}: a worker ends {} before its allocation does",
            humantime::format_duration(2 * HAND_OVER),
            humantime::format_duration(HAND_OVER)
        )),
    }
}

fn pool_name(text: &str) -> Result<String, String> {
    let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    match text.len() {
        1..=32 if text.chars().all(plain) && !text.starts_with('-') => Ok(text.to_owned()),
        _ => Err("expected 1 to 32 lower-case letters, digits and hyphens".into()),
    }
}
