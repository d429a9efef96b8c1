//! Arguments of the roles: `demo`, `up`, `coordinator`, `worker`, `workers`.

use std::{net::SocketAddr, path::PathBuf};

use clap::{Args, Subcommand};
use picofarm_database::CatalogPlace;
use picofarm_settings::{Gpus, Spots};
use serde::{Deserialize, Serialize};

use super::{Guard, ranges};

#[derive(Args)]
pub struct Demo {
    /// Folder for the catalog, the store and the pictures
    #[arg(long, default_value = "picofarm-demo", value_name = "DIR")]
    pub dir: PathBuf,
    /// Number of scenes
    #[arg(long, default_value_t = 8, value_parser = ranges::scenes)]
    pub scenes: u64,
    /// Image width and height in pixels
    #[arg(long, default_value_t = 256, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub resolution: u32,
    /// Laser spots: a grid of 1, 4, 16, 25 or 100; random:N; or places as X,Y/X,Y (0 to 1, right
    /// and down)
    #[arg(long, default_value = "25", value_parser = ranges::spots)]
    pub spots: Spots,
    /// Seed of the data set
    #[arg(long, default_value_t = 1, value_parser = ranges::whole)]
    pub seed: u64,
    /// Workers to start; they share the cores [default: 2, or 1 on a single core]
    #[arg(long, value_parser = ranges::workers)]
    pub workers: Option<usize>,
    /// Camera paths per pixel for three bounces and more
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(2..=1_048_576))]
    pub samples: u32,
    /// Furniture: auto, parametric, sweethome3d or gltf (a folder of your own models)
    #[arg(long, default_value = "auto")]
    pub assets: String,
    /// Also reconstruct each room in 3D, from the depth and shadows of its ground truth
    #[arg(long)]
    pub reconstruct: bool,
    /// End without serving pages. In a terminal, the demo otherwise serves its rooms to a browser
    /// until Ctrl-C
    #[arg(long)]
    pub no_web: bool,
    #[command(flatten)]
    pub traces: Traces,
}

#[derive(Args)]
pub struct Up {
    /// Folder for the catalog
    #[arg(long, default_value = "picofarm-data", value_name = "DIR")]
    pub dir: PathBuf,
    /// Address to listen on
    #[arg(long, default_value = "127.0.0.1:7420", value_name = "ADDR")]
    pub listen: SocketAddr,
    /// Workers to start; they share the cores
    #[arg(long, default_value_t = 1, value_parser = ranges::workers)]
    pub workers: usize,
    /// Graphics processors, divided among the workers: a number, or names from `picofarm model
    /// devices`
    #[arg(long, default_value = "0", value_name = "N|NAMES")]
    pub gpus: Gpus,
    #[command(flatten)]
    pub own: OwnPython,
    /// Serve no pages for a browser. Otherwise they are at 127.0.0.1:7421, or at a free port if
    /// that is in use
    #[arg(long)]
    pub no_web: bool,
    #[command(flatten)]
    pub http: Http,
    #[command(flatten)]
    pub guard: Guard,
    #[command(flatten)]
    pub traces: Traces,
}

#[derive(Args)]
pub struct Coordinator {
    /// Catalog: a SQLite file for one coordinator, or the URL of a Postgres database for several
    #[arg(
        long,
        default_value = "picofarm-data/catalog.sqlite",
        value_name = "FILE|URL",
        env = "PICOFARM_CATALOG",
        hide_env_values = true
    )]
    pub catalog: CatalogPlace,
    /// Address to listen on (port 0 = any free port; the address is printed)
    #[arg(long, default_value = "127.0.0.1:7420", value_name = "ADDR")]
    pub listen: SocketAddr,
    /// Seconds until a lease ends that its worker does not renew
    #[arg(long, default_value_t = 60.0, value_name = "S", value_parser = ranges::lease)]
    pub lease_s: f64,
    /// Remove jobs and their history this many days after their end; results remain in their stores
    /// [default: never]
    #[arg(long, value_name = "DAYS", value_parser = ranges::days)]
    pub forget_after_days: Option<f64>,
    /// Verify results in stores below this path or URL, or in none; may be repeated [default:
    /// folders of this machine]
    #[arg(
        long,
        value_name = "URL|none",
        env = "PICOFARM_CHECK_STORES",
        value_delimiter = ' '
    )]
    pub check_stores: Vec<String>,
    #[command(flatten)]
    pub http: Http,
    #[command(flatten)]
    pub guard: Guard,
    #[command(flatten)]
    pub traces: Traces,
}

#[derive(Args)]
pub struct Traces {
    /// OpenTelemetry collector for traces, by OTLP over gRPC, e.g. http://127.0.0.1:4317 [default:
    /// none]
    #[arg(
        long,
        value_name = "URL",
        env = "OTEL_EXPORTER_OTLP_ENDPOINT",
        hide_env_values = true
    )]
    pub otlp: Option<String>,
}

impl Traces {
    /// Returns the collector's URL, if any.
    pub(super) fn given(&self) -> Option<&str> {
        self.otlp.as_deref().filter(|url| !url.trim().is_empty())
    }

    /// Returns the collector's URL as an owned string.
    pub fn url(&self) -> Option<String> {
        self.given().map(str::to_owned)
    }
}

#[derive(Args)]
pub struct Http {
    /// Serve /healthz, /readyz and /metrics at this address over plain HTTP, without a token, e.g.
    /// 127.0.0.1:7421 (port 0 = any free port) [default: off]
    #[arg(long, value_name = "ADDR", env = "PICOFARM_HTTP")]
    pub http: Option<SocketAddr>,
}

#[derive(Subcommand)]
pub enum Workers {
    /// Let a worker finish its current task, return the others, and exit
    Drain {
        /// Name or id of the worker
        worker: String,
    },
}

#[derive(Args)]
pub struct Worker {
    /// Name of the worker [default: host name and process id]
    #[arg(long)]
    pub name: Option<String>,
    /// Threads to render with [default: all cores]
    #[arg(long, value_parser = ranges::threads)]
    pub threads: Option<usize>,
    /// Memory for tasks, GiB [default: three quarters of the least of machine, control group, Slurm
    /// job and ulimit -v]
    #[arg(long, value_name = "GIB", value_parser = ranges::gib)]
    pub memory_gib: Option<f64>,
    /// Graphics processors to use: a number, or names from `picofarm model devices`
    /// (cuda:0,cuda:1). Each is tested first
    #[arg(long, default_value = "0", value_name = "N|NAMES")]
    pub gpus: Gpus,
    #[command(flatten)]
    pub own: OwnPython,
    /// Address at which other workers reach this one to train a network together
    /// (`train.processes`). Any process that reaches it and can read the store can join
    #[arg(long, value_name = "HOST[:PORT]", default_value = "127.0.0.1")]
    pub peers: String,
    /// Label that a stage can require; may be repeated
    #[arg(long, value_name = "LABEL")]
    pub label: Vec<String>,
    /// Exit after this many seconds without work [default: never]
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(0..=1_000_000_000))]
    pub exit_idle_s: Option<u64>,
    /// Exit at a time such as 2026-12-01T18:00:00Z, or after a duration such as 3h 50m. The worker
    /// only gets tasks that should finish before it [default: a minute before the end of the Slurm
    /// job (SLURM_JOB_END_TIME), otherwise never]
    #[arg(long, value_name = "TIME|DURATION", env = "PICOFARM_END_AT", value_parser = crate::args::end_time::parse)]
    pub end_at: Option<crate::args::end_time::EndAt>,
    /// Use only stores in this path or URL; may be repeated [default: any]
    #[arg(long, value_name = "URL", value_parser = crate::args::location::parse)]
    pub store_prefix: Vec<String>,
    #[command(flatten)]
    pub traces: Traces,
}

/// Options of workers that run Python code of jobs.
#[derive(Debug, Clone, Default, Args, Serialize, Deserialize)]
pub struct OwnPython {
    /// Python (3.10 or newer) that runs code of jobs (kind = "python"), as the user of this process
    /// [default: no such jobs]
    #[arg(long, value_name = "PATH", env = "PICOFARM_PYTHON_TASKS")]
    pub python: Option<PathBuf>,
    /// Folder for virtual environments. What a stage requires (`python.requirements`) is installed
    /// there once, from the index that pip or uv is set to [default: install nothing; PATH must
    /// have it]
    #[arg(
        long,
        value_name = "DIR",
        env = "PICOFARM_PYTHON_ENVIRONMENTS",
        requires = "python"
    )]
    pub python_environments: Option<PathBuf>,
}
