//! The command line. A single definition drives the parser, the help and the completions.

mod autoalloc;
mod capture;
mod catalog;
mod data;
mod dataset;
mod demultiplex;
pub mod end_time;
mod farm;
mod figure;
pub mod groups;
mod guard;
mod input;
mod integrity;
mod job;
pub mod location;
mod model;
pub mod ranges;
mod reconstruct;
mod render;
mod scene;
mod secrets;
pub mod strategy;
mod sweep;
mod web;

use std::{ffi::OsString, path::PathBuf};

use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand};

pub use autoalloc::{Autoalloc, HAND_OVER, PoolArgs};
pub use capture::{Capture, CaptureImport, CaptureResample};
pub use catalog::{Catalog, Usage};
pub use data::{
    DatasetExport, DatasetImport, DatasetReport, DatasetReprocess, DatasetSplit, PresetArg,
    SensorArgs,
};
pub use dataset::Dataset;
pub use demultiplex::{Demultiplex, MethodArg, PlacesArg, ShadowsArg};
pub use farm::{Coordinator, Demo, Http, OwnPython, Traces, Up, Worker, Workers};
pub use figure::{ColoursArg, Figure, PanelArg};
pub use guard::{Audit, Guard, Token};
pub use input::SceneInput;
pub use integrity::{DatasetGc, DatasetRepair, DatasetShow, DatasetVerify, Snapshot};
pub use job::{Job, JobKind, ListedState};
pub use model::Model;
pub use reconstruct::{FieldArg, Reconstruct, ShadowLossArg, SpotsFrom, ViewsArg};
pub use render::{GateArgs, GateChoice, ImageSize, RenderArgs, ScenePlan, SceneRender};
pub use scene::{
    FloorPlanArg, FormatArg, GeneratorArg, PlatoArg, Scene, SceneExport, SceneGenerate, SceneSense,
};
pub use secrets::without_secrets;
pub use sweep::{Extend, MoreTrials, Sampler, Sweep, SweepRun, WhichSweep};
pub use web::{WEB, Web};

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
    /// Print JSON: one document, or one per line from commands that stream
    #[arg(long, global = true)]
    pub json: bool,
    /// Settings file [default: picofarm.toml in this folder or in the user's configuration folder]
    #[arg(long, global = true, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// URL of the coordinator; several on one catalog, separated by commas [env:
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
    /// Client certificate, PEM, for coordinators that require one [env: PICOFARM_CERT]
    #[arg(long, global = true, value_name = "FILE")]
    pub cert: Option<PathBuf>,
    /// Private key of --cert, PEM [env: PICOFARM_KEY]
    #[arg(long, global = true, value_name = "FILE")]
    pub key: Option<PathBuf>,
    /// File with your token; PICOFARM_TOKEN gives the token itself [env: PICOFARM_TOKEN_FILE]
    #[arg(long, global = true, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Log filter for stderr, e.g. info or picofarm_tasks=debug [env: PICOFARM_LOG]
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
    /// Render a few furnished rooms on this machine, verify them and draw pictures
    Demo(Demo),
    /// Run a coordinator and workers on this machine until stopped
    Up(Up),
    /// Run a coordinator
    Coordinator(Coordinator),
    /// Run a worker
    Worker(Worker),
    /// Start workers by a batch system when tasks wait, and let them end when none do
    #[command(subcommand)]
    Autoalloc(Autoalloc),
    /// Show a farm, its data sets and light in flight in a browser
    Web(Web),
    /// The process of a worker that `up` or `demo` starts
    #[command(hide = true)]
    LocalWorker,
    /// Write, plan, submit and follow jobs
    #[command(subcommand)]
    Job(Job),
    /// List the connected workers, or stop one
    Workers {
        #[command(subcommand)]
        what: Option<Workers>,
    },
    /// Show the history of all jobs
    Events {
        /// Follow until Ctrl-C
        #[arg(long, short)]
        follow: bool,
        /// With --follow: run this shell command for each new event of --kinds, e.g. to send a
        /// message. It gets the event as JSON on standard input, and PICOFARM_JOB, PICOFARM_EVENT
        /// and PICOFARM_MESSAGE
        #[arg(long, value_name = "COMMAND", requires = "follow")]
        run: Option<String>,
        /// With --run: the kinds of events
        #[arg(
            long,
            value_name = "KINDS",
            value_delimiter = ',',
            requires = "run",
            default_value = "ended,cancelled,dead,alarm"
        )]
        kinds: Vec<String>,
        /// With --run: file that keeps the last event that was handled, so that a restart misses
        /// none
        #[arg(long, value_name = "FILE", requires = "run")]
        cursor: Option<std::path::PathBuf>,
        /// Only the last N lines
        #[arg(long, default_value_t = 100, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
        last: u32,
        /// Also show what tasks logged on their workers
        #[arg(long, short)]
        verbose: bool,
    },
    /// Inspect, check, copy and convert data sets
    #[command(subcommand)]
    Dataset(Dataset),
    /// Import what a laboratory measured, check and calibrate it
    #[command(subcommand)]
    Capture(Capture),
    /// Inspect, check, export and import trained models
    #[command(subcommand)]
    Model(Model),
    /// Inspect sweeps, and add trials to them
    #[command(subcommand)]
    Sweep(Sweep),
    /// Generate, inspect and render single scenes
    #[command(subcommand)]
    Scene(Scene),
    /// Reconstruct one scene in 3D from two-bounce times and shadows, without a farm
    Reconstruct(Reconstruct),
    /// Compute depth, and the pixels that each spot lights, from the histogram of all spots, by
    /// physics
    Demultiplex(Demultiplex),
    /// Draw a figure of a render for a paper: SVG, PDF and PNG
    Figure(Figure),
    /// Manage who may use a coordinator
    #[command(subcommand)]
    Token(Token),
    /// Make certificates for a farm: an authority of its own in a folder, and one for the
    /// coordinator; the same command renews the second
    Certificates(Certificates),
    /// Show the audit log, for administrators: who submitted, stopped, paused, retried or drained
    /// what
    Audit(Audit),
    /// Show what jobs consumed: core hours, tasks, failed attempts and bytes written. A result
    /// counts once, for the job under which it was computed. Jobs without a `project` share a row
    Usage(Usage),
    /// Back up and restore a coordinator's catalog
    #[command(subcommand)]
    Catalog(Catalog),
    /// Install and list furniture for generated rooms
    #[command(subcommand)]
    Assets(Assets),
    /// Show each setting and its source
    Config,
    /// Check this machine: memory, disk, store, furniture, graphics processors, coordinator
    Doctor(Doctor),
    /// Write manual pages, one for each command, to a folder: `man -l FOLDER/picofarm.1`
    Man {
        /// The folder, e.g. ~/.local/share/man/man1
        folder: std::path::PathBuf,
    },
    /// Print completions for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

#[derive(Subcommand)]
pub enum Assets {
    /// Download Sweet Home 3D's furniture (Debian package, 120 MB) into the assets folder
    Install,
    /// List the installed furniture
    List,
    /// Make the list of a folder of .glb models, assets.csv: categories come from the names of
    /// folders and files, or from the metadata of the Amazon Berkeley Objects
    Scan {
        /// Folder of models [default: the assets folder]
        folder: Option<PathBuf>,
    },
}

#[derive(Args)]
pub struct Certificates {
    /// Folder for ca.pem, ca.key, farm.pem and farm.key
    pub folder: std::path::PathBuf,
    /// Names and addresses by which clients and workers reach the coordinator
    #[arg(
        long = "host",
        value_name = "HOSTS",
        value_delimiter = ',',
        required = true
    )]
    pub hosts: Vec<String>,
    /// Days for which the coordinator's certificate is valid
    #[arg(long, default_value_t = 365, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=3650))]
    pub days: u32,
}

#[derive(Args)]
pub struct Doctor {
    /// Store to check; it is not created [default: this folder; with --farm, none]
    #[arg(long, value_name = "PATH_OR_URL", value_parser = crate::args::location::parse)]
    pub store: Option<String>,
    /// Ask every worker of the coordinator to check its own machine: store, scenes, clock, memory,
    /// disk, furniture, graphics processors and Python
    #[arg(long)]
    pub farm: bool,
    /// Scene file, or folder with scenes, that workers must be able to read
    #[arg(long, value_name = "PATH", requires = "farm")]
    pub scenes: Option<String>,
    /// Time to wait for the answers of workers, seconds (at most 60)
    #[arg(long, value_name = "S", requires = "farm", default_value_t = 30.0, value_parser = ranges::patience)]
    pub within_s: f64,
}
