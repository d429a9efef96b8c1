//! Arguments of `picofarm job …`.

use std::path::PathBuf;

use clap::{Subcommand, ValueEnum};

#[derive(Subcommand)]
pub enum Job {
    /// Write a commented job file to start from
    Init {
        /// Where to write it [default: job.toml; with --kind, KIND.toml]
        file: Option<PathBuf>,
        /// Kind of job
        #[arg(long, value_enum)]
        kind: Option<JobKind>,
    },
    /// Check a job file without a coordinator: fields, files, furniture and stages
    Check {
        /// The job file, TOML or JSON; - reads standard input
        file: PathBuf,
        /// Use the values of the file's [scale.NAME]
        #[arg(long, value_name = "NAME")]
        scale: Option<String>,
    },
    /// Show what a submission would run and reuse; changes nothing
    Plan {
        /// The job file, TOML or JSON; - reads standard input
        file: PathBuf,
        /// Use the values of the file's [scale.NAME]
        #[arg(long, value_name = "NAME")]
        scale: Option<String>,
    },
    /// Submit a job file; the same file again returns the same job
    Submit {
        /// The job file, TOML or JSON; - reads standard input
        file: PathBuf,
        /// Use the values of the file's [scale.NAME]
        #[arg(long, value_name = "NAME")]
        scale: Option<String>,
        /// Follow the job until it ends
        #[arg(long)]
        watch: bool,
        /// Submit again after the same job failed or was cancelled
        #[arg(long, conflicts_with = "only_failed")]
        again: bool,
        /// Run only the dead tasks of the job of this file, as `job retry` does
        #[arg(long, conflicts_with_all = ["force", "from_stage"])]
        only_failed: bool,
        /// Run every task again; each result must equal the existing one, byte for byte
        #[arg(long, conflicts_with = "from_stage")]
        force: bool,
        /// Run this stage and those that need it again, with the same condition
        #[arg(long, value_name = "NAME")]
        from_stage: Option<String>,
    },
    /// List jobs, the latest first
    List {
        /// Maximum number of jobs to list
        #[arg(long, default_value_t = 50, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
        /// Continue where an earlier list ended
        #[arg(long, value_name = "TOKEN")]
        page: Option<String>,
        /// Only jobs in this state
        #[arg(long, value_name = "STATE")]
        state: Option<ListedState>,
        /// Only jobs of this user
        #[arg(long, value_name = "NAME")]
        user: Option<String>,
    },
    /// Show one job
    Status {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
    },
    /// Follow a job with progress until it ends
    Watch {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
    },
    /// Wait silently until a job ends
    Wait {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
        /// Give up after this many seconds (exit code 1)
        #[arg(long, value_name = "S", value_parser = super::ranges::seconds)]
        timeout_s: Option<f64>,
    },
    /// Cancel a job; its finished results remain
    Cancel {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
    },
    /// Pause a job: running tasks continue, and no other task starts
    Pause {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
    },
    /// Continue a paused job
    Resume {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
    },
    /// Run a job's dead tasks again. After a correction of scene files, a new job takes over the
    /// finished scenes
    Retry {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
    },
    /// Show the history of a job, or of one of its tasks with its log on the worker
    Logs {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
        /// Only this stage: its name or position [default: every stage]
        #[arg(long, value_name = "NAME")]
        stage: Option<String>,
        /// Only this task
        #[arg(long, value_parser = super::ranges::whole)]
        task: Option<u64>,
        /// Only the last N lines
        #[arg(long, default_value_t = 100, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
        last: u32,
        /// Follow until the job ends, or until Ctrl-C
        #[arg(long, short)]
        follow: bool,
        /// Also show what tasks logged on their workers; implied by --task
        #[arg(long, short)]
        verbose: bool,
    },
    /// Explain why a job does not run, or why one of its tasks ran, ran again or was reused
    Explain {
        /// Number, name or id of the job, the first letters of its id, or `last`
        job: String,
        /// The stage of the task: its name or position [default: the first]
        #[arg(long, value_name = "NAME", requires = "task")]
        stage: Option<String>,
        /// This task
        #[arg(long, value_parser = super::ranges::whole)]
        task: Option<u64>,
    },
}

/// Where a listed job stands.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum ListedState {
    Active,
    Done,
    Failed,
    Cancelled,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum JobKind {
    /// Render furnished rooms (the default)
    Furnished,
    /// Render primitive rooms
    Primitive,
    /// Render boxes on a desk, as in the paper's laboratory
    Desktop,
    /// Render scene files
    Files,
    /// Stages that need each other: render, two sensors, split, export
    Graph,
    /// Render small rooms, train three networks on them, and evaluate them
    Train,
    /// Render small rooms, and look for the settings with which a network learns best
    Sweep,
}
