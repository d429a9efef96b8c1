//! Arguments of `picofarm bench`.

use clap::{Args, Subcommand};
use picofarm_database::CatalogPlace;

use super::{BenchDataset, BenchModel, BenchRender, BenchStore, ranges};

#[derive(Subcommand)]
pub enum Bench {
    /// Measure the renderer: CPU time against the true error, by a converged render of the same
    /// scene
    Render(BenchRender),
    /// Measure the scheduler: durable no-op tasks a second against the database's own limit, and
    /// fleets of simulated workers
    Queue(BenchQueue),
    /// Measure the cost of very many (simulated, tiny) scenes: list, verify, snapshot,
    /// gc
    Dataset(BenchDataset),
    /// Measure storage on scenes of this renderer: size, error and speed of all profiles, and of
    /// reading
    Store(BenchStore),
    /// Measure a training step of a network on the CPU against other forms and other programs
    Model(BenchModel),
}

#[derive(Args)]
pub struct BenchQueue {
    /// The catalog: a SQLite file or the URL of a Postgres database [default: a new SQLite file
    /// that is removed after]
    #[arg(
        long,
        value_name = "FILE|URL",
        env = "PICOFARM_CATALOG",
        hide_env_values = true
    )]
    pub catalog: Option<CatalogPlace>,
    /// Simulated workers of the no-op tasks
    #[arg(long, default_value_t = 8, value_parser = ranges::simulated)]
    pub workers: usize,
    /// No-op tasks to run end to end; 0 leaves this part out
    #[arg(long, default_value_t = 200_000)]
    pub tasks: u64,
    /// Sizes of jobs to submit
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "N,…",
        default_value = "97432,1000000"
    )]
    pub submit: Vec<u64>,
    /// Sizes of fleets to simulate with tasks of a fixed length, e.g. 10,100,1000,4000
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    pub fleet: Vec<usize>,
    /// Plans of large jobs that run while heartbeats are measured; 0 omits this part
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub plans: usize,
    /// Size of such a job in MB
    #[arg(long, default_value_t = 43, value_name = "MB", value_parser = clap::value_parser!(u64).range(1..=60))]
    pub plan_mb: u64,
    /// Length of a fleet's tasks in seconds
    #[arg(long, default_value_t = 30.0, value_name = "S", value_parser = ranges::seconds)]
    pub task_s: f64,
    /// Tasks a worker of a fleet
    #[arg(long, default_value_t = 3)]
    pub rounds: u64,
    /// Kill the coordinator in the middle of a fleet's run and start another: all workers come back
    /// at once
    #[arg(long)]
    pub restart: bool,
    /// Lease time to live in seconds
    #[arg(long, default_value_t = 60.0, value_name = "S", value_parser = ranges::lease)]
    pub lease_s: f64,
    /// Forget jobs this many days after their end, with their history; results stay in their stores
    /// [default: never]
    #[arg(long, value_name = "DAYS", value_parser = ranges::days)]
    pub forget_after_days: Option<f64>,
}
