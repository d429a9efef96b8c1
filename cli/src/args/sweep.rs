//! Arguments of `picofarm sweep …`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

const EXTEND_HELP: &str = "\
The file lists the values of all trials (sweep.values) and is otherwise the same. Submitted, it reuses the trials that have
ended and trains only the new ones. The best gets a name of its own, since a name belongs to one training for good.";

const RUN_HELP: &str = "\
Round 0 is the file itself. A round's file that is there from an earlier run is submitted as it is, so a command that was
interrupted goes on when it is given again.";

#[derive(Subcommand)]
pub enum Sweep {
    /// Show each trial: values, epochs, error
    Status(WhichSweep),
    /// Show the best finished trial
    Best(WhichSweep),
    /// Write a page about the trials: ranking, curves, parameters
    Report {
        #[command(flatten)]
        which: WhichSweep,
        /// Page to write, with its data as JSON next to it
        #[arg(long, value_name = "FILE", default_value = "sweep.html")]
        out: PathBuf,
    },
    /// Write the trials as CSV: a row for each trial, or for each epoch
    Export {
        #[command(flatten)]
        which: WhichSweep,
        /// The file to write
        #[arg(long, value_name = "FILE", default_value = "sweep.csv")]
        out: PathBuf,
        /// Write a row for each epoch of ended trials: loss, learning rate and validation
        #[arg(long)]
        curves: bool,
    },
    /// Compare sweeps: best trial, ends of trials, error by epochs spent
    Compare {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Names of sweeps: NAME for all of that name, NAME/ID for one
        #[arg(required = true)]
        names: Vec<String>,
    },
    /// Write a job file with more trials, chosen by the results of the ended ones
    #[command(after_help = EXTEND_HELP)]
    Extend(Extend),
    /// Submit a job file with a sweep, wait, extend and submit it, in rounds
    #[command(after_help = RUN_HELP)]
    Run(SweepRun),
}

#[derive(Args)]
pub struct WhichSweep {
    /// Folder or URL of the store
    #[arg(value_parser = crate::args::location::parse)]
    pub store: String,
    /// Name of the sweep, which is the name of its model
    pub name: String,
    /// First digits of the sweep's id, if several sweeps have that name
    #[arg(long, value_name = "ID", default_value = "")]
    pub id: String,
}

/// Who chooses values.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Sampler {
    /// Tree-structured Parzen estimator; at random until 10 trials have ended
    Tpe,
    /// At random
    Random,
}

/// Which sweep gets further trials, and who chooses them.
#[derive(Args)]
pub struct MoreTrials {
    /// The job file, or its latest extension
    pub file: PathBuf,
    /// Number of trials to add
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..1000))]
    pub trials: u64,
    /// How to choose their values
    #[arg(long, value_enum, default_value_t = Sampler::Tpe)]
    pub sampler: Sampler,
    /// The stage with the sweep, if the job has several
    #[arg(long, value_name = "NAME")]
    pub stage: Option<String>,
    /// Use the values of the file's [scale.NAME]
    #[arg(long, value_name = "NAME")]
    pub scale: Option<String>,
}

#[derive(Args)]
pub struct Extend {
    #[command(flatten)]
    pub more: MoreTrials,
    /// Name for the best model [default: MODEL-TRIALS, e.g. depth-40]
    #[arg(long, value_name = "NAME")]
    pub promote: Option<String>,
    /// The file to write, in the same folder [default: FILE-TRIALS.toml, e.g. sweep-40.toml]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

#[derive(Args)]
pub struct SweepRun {
    #[command(flatten)]
    pub more: MoreTrials,
    /// Number of extensions
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..1000))]
    pub rounds: u32,
}
