//! The command line. A single definition drives the parser, the help and the completions.

mod data;
mod demultiplex;
mod guard;
mod integrity;
mod job;
mod model;
mod network;
mod ranges;
mod reconstruct;
pub(crate) mod render;
mod secrets;
mod sweep;

use std::{ffi::OsString, net::SocketAddr, path::PathBuf};

use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use picofarm_database::CatalogPlace;
use picofarm_settings::{Gpus, Spots};

pub use data::{
    BenchStore, DatasetExport, DatasetImport, DatasetReport, DatasetReprocess, DatasetSplit,
    SensorArgs,
};
pub use demultiplex::{Demultiplex, PlacesArg, ShadowsArg};
pub use guard::{Audit, Guard, Token};
pub use integrity::{BenchDataset, DatasetGc, DatasetRepair, DatasetShow, DatasetVerify, Snapshot};
pub use job::{Job, JobKind, ListedState};
pub use model::Model;
pub use network::{BenchModel, Kind, Learns, Numbers};
pub use reconstruct::{FieldArg, Reconstruct, ShadowLossArg, SpotsFrom, ViewsArg};
pub use render::{BenchRender, RenderArgs, ScenePlan, SceneRender, SceneRoot};
pub use secrets::without_secrets;
pub use sweep::{Extend, MoreTrials, Sampler, Sweep, SweepRun, WhichSweep};

/// Render farm for time-resolved lidar histograms.
#[derive(Parser)]
#[command(name = "picofarm", version, propagate_version = true, after_help = EXIT_CODES)]
pub struct Cli {
    #[command(flatten)]
    pub global: Global,
    #[command(subcommand)]
    pub command: Command,
}

/// Returns the command line's definition. `-1` is parsed as a value if a value is expected, so that
/// it is rejected as a value and not as an unknown option.
pub fn command() -> clap::Command {
    fn numbers(command: clap::Command) -> clap::Command {
        command
            .mut_args(|arg| match arg.get_action().takes_values() {
                true => arg.allow_negative_numbers(true),
                false => arg,
            })
            .mut_subcommands(numbers)
    }
    numbers(Cli::command())
}

/// Parses a command line.
///
/// # Errors
/// Returns clap's error, without possible secrets in URLs.
pub fn parse(
    words: impl IntoIterator<Item = OsString>,
    version: &'static str,
) -> Result<Cli, clap::Error> {
    let mut command = command().long_version(version);
    let cli = command
        .try_get_matches_from_mut(words)
        .and_then(|mut given| Cli::from_arg_matches_mut(&mut given));
    cli.map_err(|e| secrets::hidden(e.format(&mut command)))
}

const EXIT_CODES: &str = "\
Exit codes:
  0    done
  1    something failed that is not listed here
  2    wrong arguments
  3    bad input: a job file, scene file, setting or scene that cannot be used
  4    the coordinator cannot be reached, or refused (another version, no access)
  5    the job ended with dead tasks, or was cancelled
  6    a data set is damaged or incomplete
  7    a resource is taken or missing: port in use, disk full, store read-only
  130  interrupted";

#[derive(Args, Clone)]
#[command(next_help_heading = "Global options")]
pub struct Global {
    /// Print machine-readable JSON (one document; one a line where a command streams)
    #[arg(long, global = true)]
    pub json: bool,
    /// Settings file [default: picofarm.toml here, else in the user's configuration folder]
    #[arg(long, global = true, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// URL of the coordinator; of several on one catalog, with commas between [env:
    /// PICOFARM_COORDINATOR]
    #[arg(long, global = true, value_name = "URL")]
    pub coordinator: Option<String>,
    /// Folder with furniture assets [env: PICOFARM_ASSETS]
    #[arg(long, global = true, value_name = "DIR")]
    pub assets_dir: Option<PathBuf>,
    /// Certificate authority of the coordinator, PEM [default: those of the system] [env:
    /// PICOFARM_CA]
    #[arg(long, global = true, value_name = "FILE")]
    pub ca: Option<PathBuf>,
    /// Own certificate for coordinators that want one, PEM [env: PICOFARM_CERT]
    #[arg(long, global = true, value_name = "FILE")]
    pub cert: Option<PathBuf>,
    /// Private key of --cert, PEM [env: PICOFARM_KEY]
    #[arg(long, global = true, value_name = "FILE")]
    pub key: Option<PathBuf>,
    /// File with the token that proves who you are; or set PICOFARM_TOKEN [env:
    /// PICOFARM_TOKEN_FILE]
    #[arg(long, global = true, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Log filter for stderr, e.g. info or picofarm_agent=debug [env: PICOFARM_LOG]
    #[arg(long, global = true, value_name = "FILTER")]
    pub log: Option<String>,
}

impl Command {
    /// Returns the trace collector's URL and the command's service name; `None` for commands that
    /// run no part of a farm.
    pub fn traces(&self) -> Option<(&str, &'static str)> {
        let (traces, service) = match self {
            Self::Demo(demo) => (&demo.traces, "picofarm"),
            Self::Up(up) => (&up.traces, "picofarm"),
            Self::Coordinator(coordinator) => (&coordinator.traces, "picofarm-coordinator"),
            Self::Worker(worker) => (&worker.traces, "picofarm-worker"),
            _ => return None,
        };
        traces.given().map(|url| (url, service))
    }
}

#[derive(Subcommand)]
pub enum Command {
    /// Render a small furnished-room data set end to end on this machine, and show it
    Demo(Demo),
    /// Run a coordinator and workers on this machine until stopped
    Up(Up),
    /// Run a coordinator
    Coordinator(Coordinator),
    /// Run a worker
    Worker(Worker),
    /// The process of a worker that `up` or `demo` starts
    #[command(hide = true)]
    LocalWorker,
    /// Write, plan, submit and follow jobs
    #[command(subcommand)]
    Job(Job),
    /// List the workers connected to the coordinator, or tell one to end
    Workers {
        #[command(subcommand)]
        what: Option<Workers>,
    },
    /// Show what happened, of all jobs
    Events {
        /// Go on showing what happens, until Ctrl-C
        #[arg(long, short)]
        follow: bool,
        /// The last N lines before now
        #[arg(long, default_value_t = 100, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
        last: u32,
        /// What tasks logged on their workers, too
        #[arg(long, short)]
        verbose: bool,
    },
    /// Look at data sets, check them, and make others of them
    #[command(subcommand)]
    Dataset(Dataset),
    /// Look at trained models, and take their weights out
    #[command(subcommand)]
    Model(Model),
    /// Look at sweeps: how their trials fare, which is the best, which values to try next
    #[command(subcommand)]
    Sweep(Sweep),
    /// Make, inspect and render single scenes
    #[command(subcommand)]
    Scene(Scene),
    /// Reconstruct one scene in 3D from two-bounce times and shadows, without a farm: mesh, density
    /// and errors
    Reconstruct(Reconstruct),
    /// Take one flash apart by physics: depth, and which pixels each spot lights, from the
    /// histogram of all spots at once
    Demultiplex(Demultiplex),
    /// Say who may use a coordinator
    #[command(subcommand)]
    Token(Token),
    /// Show who submitted, stopped, held, retried or drained what, or tried to; for administrators
    Audit(Audit),
    /// Furniture for generated rooms
    #[command(subcommand)]
    Assets(Assets),
    /// Measure on this machine
    #[command(subcommand)]
    Bench(Bench),
    /// Show the settings in force and where each comes from
    Config,
    /// Check this machine: store, disk, coordinator, furniture
    Doctor(Doctor),
    /// Print completions for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

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
    fn given(&self) -> Option<&str> {
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
    #[arg(long, value_name = "TIME|DURATION", env = "PICOFARM_END_AT", value_parser = crate::ends::parse)]
    pub end_at: Option<crate::ends::EndAt>,
    /// Touch only stores in this path or URL (give it again for more) [default: anything]
    #[arg(long, value_name = "URL", value_parser = crate::paths::place)]
    pub store_prefix: Vec<String>,
    #[command(flatten)]
    pub traces: Traces,
}

#[derive(Subcommand)]
pub enum Dataset {
    /// Summarise a data set
    Info {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::paths::place)]
        dataset: String,
    },
    /// Say where a scene came from: job, code version, seed, scene, parents
    Show(DatasetShow),
    /// Check a data set against its manifests; exit code 6 if anything is wrong
    Verify(DatasetVerify),
    /// Make broken scenes again, exactly those, and restore their damaged objects
    Repair(DatasetRepair),
    /// Pin which scenes there are now, or see what was pinned
    #[command(subcommand)]
    Snapshot(Snapshot),
    /// Find objects that belong to no finished scene, left by killed workers, and delete them if
    /// asked to
    #[command(alias = "collect")]
    Gc(DatasetGc),
    /// Draw a contact sheet (PNG) and a light-in-flight animation (GIF) of a data set; of
    /// reconstructions, a contact sheet
    Picture {
        /// Folder or URL of the data set, or of reconstructions
        #[arg(value_parser = crate::paths::place)]
        dataset: String,
        /// Folder for the pictures
        #[arg(long, default_value = ".", value_name = "DIR")]
        out: PathBuf,
        /// Rows of the contact sheet at most
        #[arg(long, default_value_t = 8, value_parser = ranges::rows)]
        rows: usize,
    },
    /// Write a page about reconstructions, and its data as JSON: errors of novel views next to
    /// published ones, meshes, the best and the worst scene
    Report(DatasetReport),
    /// Measure every scene with a sensor into another data set, without rendering; again to resume
    Reprocess(DatasetReprocess),
    /// Pack a data set, or a part of it, into few files for sharing, or write it in the paper's
    /// layout; again to resume
    Export(DatasetExport),
    /// Make a data set of the paper's release, of PlatoNeRF's or bounce-flash lidar captures, or of
    /// .npy files; again to resume
    Import(Box<DatasetImport>),
    /// Say which scenes are for training, validation and test; again to take in scenes added since
    Split(DatasetSplit),
}

#[derive(Subcommand)]
pub enum Scene {
    /// Generate a scene from a seed and write it as .glb
    Generate {
        /// Kind of scene; desktop is a box on a desk as laboratories have it, plato the room that
        /// reconstructions are measured in
        #[arg(long, value_enum, default_value_t = GeneratorArg::Furnished)]
        kind: GeneratorArg,
        /// Seed
        #[arg(long, default_value_t = 1, value_parser = ranges::whole)]
        seed: u64,
        /// Where to write it
        #[arg(long, default_value = "scene.glb", value_name = "FILE")]
        out: PathBuf,
        /// Laser spots: a grid of 1, 4, 16, 25 or 100; random:N; or places as X,Y/X,Y (0 to 1,
        /// right and down) [default: 25; 16 in desktop and plato rooms; plato rooms take a number
        /// up to 16]
        #[arg(long, value_parser = ranges::spots)]
        spots: Option<Spots>,
        /// Image width and height in pixels
        #[arg(long, default_value_t = 256, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=4096))]
        resolution: u32,
        /// Furniture: auto, parametric, sweethome3d or gltf (a folder of your own models)
        #[arg(long, default_value = "auto")]
        assets: String,
        /// What stands in a plato room
        #[arg(long, value_enum, default_value_t = PlatoArg::Chair)]
        object: PlatoArg,
    },
    /// Say what a scene file holds
    Show {
        /// A .glb, .gltf, .xml (Mitsuba) or .json scene
        file: PathBuf,
        #[command(flatten)]
        root: SceneRoot,
    },
    /// Write a scene in another format: .glb, Mitsuba 3 (.xml, with meshes and textures) or
    /// one .ply mesh
    Export(SceneExport),
    /// Render one scene file without a farm into a small Zarr group
    Render(SceneRender),
    /// Say what rendering a scene file would take, without rendering it
    Plan(ScenePlan),
    /// Measure a rendered scene with a sensor: pulse, jitter, photon noise, wider bins
    Sense(SceneSense),
}

#[derive(Args)]
pub struct SceneExport {
    /// A .glb, .gltf, .xml (Mitsuba), .json or .ply scene
    pub file: PathBuf,
    #[command(flatten)]
    pub root: SceneRoot,
    /// Where to write it: a file, or a folder for scene.glb, scene.xml or scene.ply
    #[arg(long, value_name = "DIR_OR_FILE")]
    pub out: PathBuf,
    /// Format [default: by the extension of --out]
    #[arg(long, value_enum)]
    pub format: Option<FormatArg>,
    /// Laser spots in the camera's view, in place of the file's: a grid of 1, 4, 16, 25 or 100;
    /// random:N; or places as X,Y/X,Y (0 to 1, right and down)
    #[arg(long, value_parser = ranges::spots)]
    pub spots: Option<Spots>,
    /// Put a camera in front of a file without one (.ply), and 25 spots if --spots does not say
    /// otherwise
    #[arg(long)]
    pub frame: bool,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum FormatArg {
    Glb,
    Mitsuba,
    Ply,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum GeneratorArg {
    Furnished,
    Primitive,
    Desktop,
    Plato,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum PlatoArg {
    Chair,
    Armchair,
    HiddenBox,
    Empty,
}

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

#[derive(Args)]
pub struct SceneSense {
    /// A Zarr group that `picofarm scene render` wrote; it is only read
    pub render: PathBuf,
    /// Folder for the new Zarr group (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[command(flatten)]
    pub sensor: SensorArgs,
    /// Seed of the random numbers
    #[arg(long, default_value_t = 0, value_parser = ranges::whole)]
    pub seed: u64,
    /// Number of the scene, which gives scenes of one seed random numbers of their own
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = ranges::whole)]
    pub scene: u64,
    /// Threads [default: all cores]
    #[arg(long, value_parser = ranges::threads)]
    pub threads: Option<usize>,
}

#[derive(Subcommand)]
pub enum Assets {
    /// Fetch Sweet Home 3D's furniture (Debian package, 120 MB) into the assets folder
    Install,
    /// Say which furniture is installed
    List,
}

#[derive(Args)]
pub struct Doctor {
    /// Store to check, which is not made if it does not exist [default: the current folder]
    #[arg(long, default_value = ".", value_name = "PATH_OR_URL", value_parser = crate::paths::place)]
    pub store: String,
}
