//! Arguments of the roles: `demo`, `up`, `coordinator`, `worker`, `workers`.

use std::{net::SocketAddr, path::PathBuf};

use clap::{Args, Subcommand};
use picofarm_database::CatalogPlace;
use picofarm_settings::{Gpus, Spots};

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
    /// Then reconstruct each room in 3D, from the depth and shadows of its ground truth: meshes,
    /// errors, pictures
    #[arg(long)]
    pub reconstruct: bool,
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
    /// Graphics processors, dealt to the workers in turn: how many, or which, as `picofarm model
    /// devices` names them
    #[arg(long, default_value = "0", value_name = "N|NAMES")]
    pub gpus: Gpus,
    #[command(flatten)]
    pub http: Http,
    #[command(flatten)]
    pub guard: Guard,
    #[command(flatten)]
    pub traces: Traces,
}

#[derive(Args)]
pub struct Coordinator {
    /// The catalog: a SQLite file, for one coordinator, or the URL of a Postgres database, for
    /// several
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
    /// Lease time to live in seconds
    #[arg(long, default_value_t = 60.0, value_name = "S", value_parser = ranges::lease)]
    pub lease_s: f64,
    /// Forget jobs this many days after their end, with their history; results stay in their stores
    /// [default: never]
    #[arg(long, value_name = "DAYS", value_parser = ranges::days)]
    pub forget_after_days: Option<f64>,
    /// Verify results in stores below this path or URL (give it again for more), or in none
    /// [default: in folders of this machine; no host is asked]
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
    /// Send traces to an OpenTelemetry collector by OTLP over gRPC, e.g. http://127.0.0.1:4317
    /// [default: nowhere]
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
    /// Serve /healthz, /readyz and /metrics here over plain HTTP, e.g. 127.0.0.1:7421 (port 0 = any
    /// free port; the address is printed). Counts only, no names; whoever reaches the address may
    /// read them without a token [default: nowhere]
    #[arg(long, value_name = "ADDR", env = "PICOFARM_HTTP")]
    pub http: Option<SocketAddr>,
}

#[derive(Subcommand)]
pub enum Workers {
    /// Tell a worker to finish the task in hand, give the rest back, and end
    Drain {
        /// Its name or id
        worker: String,
    },
}

#[derive(Args)]
pub struct Worker {
    /// Name, for people [default: host name and process id]
    #[arg(long)]
    pub name: Option<String>,
    /// Threads to render with [default: all cores]
    #[arg(long, value_parser = ranges::threads)]
    pub threads: Option<usize>,
    /// Memory that tasks may take, GiB [default: three quarters of what this machine, its control
    /// group, the Slurm job and ulimit -v leave]
    #[arg(long, value_name = "GIB", value_parser = ranges::gib)]
    pub memory_gib: Option<f64>,
    /// Graphics processors it may use: how many, or which, as `picofarm model devices` names them
    /// (cuda:0,cuda:1). Each is tried before it is used
    #[arg(long, default_value = "0", value_name = "N|NAMES")]
    pub gpus: Gpus,
    /// Address of this machine at which other workers reach this one, to train a network together
    /// (`train.processes`); whoever reaches it and can read the store can join
    #[arg(long, value_name = "HOST[:PORT]", default_value = "127.0.0.1")]
    pub peers: String,
    /// Label that stages may ask for (give it again for more)
    #[arg(long, value_name = "LABEL")]
    pub label: Vec<String>,
    /// End after this many seconds without work [default: never]
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(0..=1_000_000_000))]
    pub exit_idle_s: Option<u64>,
    /// Stop work then and give the rest back: a time such as 2026-12-01T18:00:00Z, or a duration
    /// such as 3h 50m. The coordinator grants only what the worker can finish by then [default: a
    /// minute before the end of the Slurm job (SLURM_JOB_END_TIME); otherwise never]
    #[arg(long, value_name = "TIME|DURATION", env = "PICOFARM_END_AT", value_parser = crate::args::end_time::parse)]
    pub end_at: Option<crate::args::end_time::EndAt>,
    /// Touch only stores in this path or URL (give it again for more) [default: anything]
    #[arg(long, value_name = "URL", value_parser = crate::args::location::parse)]
    pub store_prefix: Vec<String>,
    #[command(flatten)]
    pub traces: Traces,
}
