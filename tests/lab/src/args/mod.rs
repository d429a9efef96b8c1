//! The command line.

mod model;
pub mod strategies;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use picofarm_cli::args::{GateArgs, Global, location, ranges};
use picofarm_database::CatalogPlace;

pub use model::{Kind, Learns, Model, Numbers};
use strategies::Word;

/// Benchmarks of picofarm, and comparisons with other programs.
#[derive(Parser)]
#[command(name = "picofarm-lab")]
pub struct Lab {
    #[command(flatten)]
    pub global: Global,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Measure the renderer: CPU time against the true error, by a converged render of the same
    /// scene
    Render(Render),
    /// Measure the scheduler: durable no-op tasks a second against the database's own limit, and
    /// fleets of simulated workers
    Queue(Queue),
    /// Measure the pages of `picofarm web` at many jobs and workers, and the coordinator's CPU with
    /// many viewers
    Pages(Pages),
    /// Measure the CPU of real tasks that take next to no time: scenes of one pixel, with
    /// coordinator and workers on this machine
    Small(Small),
    /// Measure the cost of very many (simulated, tiny) scenes: list, verify, snapshot, gc
    Dataset(Dataset),
    /// Measure storage on scenes of this renderer: size, error and speed of all profiles, and of
    /// reading
    Store(Store),
    /// Measure a training step of a network against other forms and other programs
    Model(Model),
    /// Measure rays per second of the renderer's tree: [--export DIR] [--rounds N] [--only RAYS]
    /// [--kernel avx2|portable]
    Rays(Words),
    /// Measure the speed of the sensor model
    Sensor,
    /// Compare stated with true errors on scenes that are hard to sample, or measure rooms:
    /// [SCENE [SEEDS [PIXELS [ERROR…]]]], or rooms [ROOMS [PIXELS [ERROR [LIBRARY [FOLDER]]]]]
    Stop(Words),
    /// Measure reconstructions of PlatoNeRF's room: [captures] [ambient] [peers] [sampling] [rooms]
    /// [quick] [=TEXT…]
    Plato(Words),
    /// Print the agreement of right and of wrong measurements: [SCENE…]
    Agreement(Words),
    /// Measure PlatoNeRF's networks: step, grid, memory WIDTH, or curve WIDTH BATCH COARSE FINE
    /// DISTANCE_STEPS SHADOW_STEPS squares|cross_entropy
    Chair(Words),
}

/// Words that a benchmark reads itself.
#[derive(Args)]
pub struct Words {
    #[arg(
        value_name = "WORD",
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    pub words: Vec<String>,
}

#[derive(Args)]
pub struct Render {
    /// Scene files, or presets: furnished, primitive, furnished:SEED, primitive:SEED
    #[arg(default_values = ["furnished", "primitive"], value_name = "SCENE")]
    pub scenes: Vec<String>,
    /// Image width and height in pixels [default: 32; with --scaling 256, with --quick 32]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub resolution: Option<u32>,
    /// Laser spots of the presets: 1, 4, 16, 25 or 100
    #[arg(long, default_value_t = 25, value_parser = ranges::grid)]
    pub spots: u32,
    /// Split triangles into four until the scene has at least this many
    #[arg(long, value_name = "N")]
    pub triangles: Option<usize>,
    /// Camera paths per pixel of each rung
    #[arg(long, value_delimiter = ',', default_value = "2,8,32,128", value_name = "N,…",
          value_parser = clap::value_parser!(u32).range(1..))]
    pub ladder: Vec<u32>,
    /// Renders for each rung, each with a seed of its own; times and errors are averaged
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=64))]
    pub seeds: u64,
    /// Camera paths per pixel of the converged render [default: 16 times the largest rung, at least
    /// 8 times what the stopping rule took]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
    pub truth_samples: Option<u32>,
    /// Compare against this converged render, a folder from `picofarm scene render --split` (one
    /// scene)
    #[arg(long, value_name = "DIR", conflicts_with = "truth_samples")]
    pub truth: Option<PathBuf>,
    /// Errors to give the time for; the stopping rule is tried with the first
    #[arg(long, value_delimiter = ',', default_value = "10%,5%,2%", value_name = "E,…",
          value_parser = picofarm_proto::spec::parse_share)]
    pub error: Vec<f64>,
    /// Threads of the measured renders (the converged one uses all cores)
    #[arg(long, default_value_t = 1, value_parser = ranges::threads)]
    pub threads: usize,
    /// Measurements of another renderer, written by tests/lab/peers; may be given several times
    #[arg(long, value_name = "FILE")]
    pub peer: Vec<PathBuf>,
    /// Ways of finding light to compare: default, choices as for `scene render --strategy`, joined
    /// by +, or each, which leaves out one in turn (also what the option stands for without a
    /// value)
    #[arg(long, value_delimiter = ',', num_args = 0..=1, default_value = "default", default_missing_value = "each",
          value_name = "default|each|NAME=VALUE[+…],…", value_parser = strategies::parse)]
    pub strategies: Vec<Word>,
    /// Draw time against error into this PNG
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
    /// Instead: how the time to the first error grows with triangles, spots, bins and pixels
    #[arg(long, conflicts_with_all = ["ladder", "seeds", "truth_samples", "truth", "peer", "plot", "triangles", "spots", "strategies"])]
    pub scaling: bool,
    /// With --scaling: small sizes, for a look in a minute or two
    #[arg(long, requires = "scaling")]
    pub quick: bool,
    #[command(flatten)]
    pub gate: GateArgs,
}

#[derive(Args)]
pub struct Queue {
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

#[derive(Args)]
pub struct Pages {
    /// The catalog: a SQLite file or the URL of a Postgres database, empty or filled by an earlier
    /// run [default: a new SQLite file that is removed after]
    #[arg(
        long,
        value_name = "FILE|URL",
        env = "PICOFARM_CATALOG",
        hide_env_values = true
    )]
    pub catalog: Option<CatalogPlace>,
    /// Jobs
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(300..))]
    pub jobs: u64,
    /// Tasks of all jobs; half of them belong to one
    #[arg(long, default_value_t = 100_000)]
    pub tasks: u64,
    /// Simulated workers
    #[arg(long, default_value_t = 1000, value_parser = ranges::simulated)]
    pub workers: usize,
    /// Viewers that follow pages
    #[arg(long, default_value_t = 50)]
    pub viewers: usize,
    /// Requests of each page
    #[arg(long, default_value_t = 100)]
    pub asks: usize,
}

#[derive(Args)]
pub struct Small {
    /// Workers
    #[arg(long, default_value_t = 2, value_parser = ranges::workers)]
    pub workers: usize,
    /// Scenes of one pixel
    #[arg(long, default_value_t = 2_000, value_parser = clap::value_parser!(u64).range(1..))]
    pub tasks: u64,
    /// Folder for the store and the catalog, on the disk to be measured [default: the system's
    /// temporary folder]
    #[arg(long, value_name = "DIR")]
    pub dir: Option<PathBuf>,
}

#[derive(Args)]
pub struct Dataset {
    /// Folder to simulate the data set in; it must not exist, or be empty, and is removed at the
    /// end
    #[arg(long, value_name = "DIR")]
    pub dir: PathBuf,
    /// Sizes to measure at; a scene takes some 50 inodes and, where small folders take a block
    /// each, 120 kB
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "N,…",
        default_value = "1000,3000,10000"
    )]
    pub scenes: Vec<u64>,
    /// Leave the data set there
    #[arg(long)]
    pub keep: bool,
}

#[derive(Args)]
pub struct Store {
    /// Folder or URL of a data set with the profile lossless to take scenes from, instead of
    /// rendering some
    #[arg(long, value_name = "DATASET", value_parser = location::parse, conflicts_with_all = ["keep", "resolution", "samples", "seed"])]
    pub from: Option<String>,
    /// Number of scenes
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u64).range(1..=64))]
    pub scenes: u64,
    /// Image width and height in pixels
    #[arg(long, default_value_t = 256, value_name = "PX", value_parser = clap::value_parser!(u32).range(8..=1024))]
    pub resolution: u32,
    /// Camera paths per pixel for three bounces and more
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u32).range(2..=1_048_576))]
    pub samples: u32,
    /// Seed of the rooms
    #[arg(long, default_value_t = 11, value_parser = ranges::whole)]
    pub seed: u64,
    /// Render into this folder and keep it: the next run with it renders nothing [default: a folder
    /// that is removed after]
    #[arg(long, value_name = "DIR")]
    pub keep: Option<PathBuf>,
    /// Leave out how fast scenes are read
    #[arg(long)]
    pub no_reading: bool,
}
