//! Arguments of `picofarm job …`.

use std::path::PathBuf;

use clap::{Subcommand, ValueEnum};

#[derive(Subcommand)]
pub enum Job {
    /// Write a commented job file to start from
    Init {
        /// Where to write it [default: job.toml; with --kind, KIND.toml]
        file: Option<PathBuf>,
        /// What kind of job
        #[arg(long, value_enum)]
        kind: Option<JobKind>,
    },
    /// Say what a submission would run and what it would reuse; changes nothing
    Plan {
        /// The job file
        file: PathBuf,
        /// Which of the sizes that the file has: the values of its [scale.NAME]
        #[arg(long, value_name = "NAME")]
        scale: Option<String>,
    },
    /// Submit a job file; the same file again answers with the same job
    Submit {
        /// The job file
        file: PathBuf,
        /// Which of the sizes that the file has: the values of its [scale.NAME]
        #[arg(long, value_name = "NAME")]
        scale: Option<String>,
        /// Follow the job until it ends
        #[arg(long)]
        watch: bool,
        /// Submit again although the same job failed or was cancelled
        #[arg(long, conflicts_with = "only_failed")]
        again: bool,
        /// Only the tasks that were given up when this file was submitted before: the same as `job
        /// retry`
        #[arg(long, conflicts_with_all = ["force", "from_stage"])]
        only_failed: bool,
        /// Run every task although its result exists; each must come out the same, byte for byte
        #[arg(long, conflicts_with = "from_stage")]
        force: bool,
        /// The same for this stage and those that need it
        #[arg(long, value_name = "NAME")]
        from_stage: Option<String>,
    },
    /// List jobs, the latest first
    List {
        /// How many at most
        #[arg(long, default_value_t = 50, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
        /// Go on where an earlier list ended
        #[arg(long, value_name = "TOKEN")]
        page: Option<String>,
        /// Only jobs that stand so
        #[arg(long, value_name = "STATE")]
        state: Option<ListedState>,
        /// Only jobs of this user
        #[arg(long, value_name = "NAME")]
        user: Option<String>,
    },
    /// Show one job
    Status {
        /// Job id, or the first letters of one
        job: String,
    },
    /// Follow a job with progress until it ends
    Watch {
        /// Job id, or the first letters of one
        job: String,
    },
    /// Wait silently until a job ends
    Wait {
        /// Job id, or the first letters of one
        job: String,
        /// Give up after this many seconds (exit code 1)
        #[arg(long, value_name = "S", value_parser = super::ranges::seconds)]
        timeout_s: Option<f64>,
    },
    /// Stop a job; what it finished stays
    Cancel {
        /// Job id, or the first letters of one
        job: String,
    },
    /// Hold a job: what runs goes on, nothing else is begun
    Pause {
        /// Job id, or the first letters of one
        job: String,
    },
    /// Let a held job go on
    Resume {
        /// Job id, or the first letters of one
        job: String,
    },
    /// Make a job's dead tasks pending again; with corrected scene files, in a new job that takes
    /// over the finished scenes
    Retry {
        /// Job id, or the first letters of one
        job: String,
    },
    /// Show what happened to a job, or to one of its tasks and what it logged on its worker
    Logs {
        /// Job id, or the first letters of one
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
        /// Go on showing what happens, until the job ends or Ctrl-C
        #[arg(long, short)]
        follow: bool,
        /// What tasks logged on their workers, too; with --task it is always shown
        #[arg(long, short)]
        verbose: bool,
    },
    /// Say why a job does not run, or why one of its tasks was run, run again or reused
    Explain {
        /// Job id, or the first letters of one
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
