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
    /// Say how each trial fares: its values, how far it came, how good it was there
    Status(WhichSweep),
    /// Say which trial is the best of those that came to their end
    Best(WhichSweep),
    /// Write a page about the trials: from best to worst, over epochs, by parameter
    Report {
        #[command(flatten)]
        which: WhichSweep,
        /// The page to write; the same data as JSON goes next to it
        #[arg(long, value_name = "FILE", default_value = "sweep.html")]
        out: PathBuf,
    },
    /// Write the trials as CSV: a row for each, or for each epoch of each
    Export {
        #[command(flatten)]
        which: WhichSweep,
        /// The file to write
        #[arg(long, value_name = "FILE", default_value = "sweep.csv")]
        out: PathBuf,
        /// A row for each epoch of trials that ended: loss, rate and validation along the training
        #[arg(long)]
        curves: bool,
    },
    /// Compare sweeps: the best of each, how its trials ended, and the least error by epochs spent
    Compare {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Names of sweeps; NAME/ID for one of several that are called so, NAME for all of them
        #[arg(required = true)]
        names: Vec<String>,
    },
    /// Write a job file with further trials of a sweep, chosen by what those that have ended found
    #[command(after_help = EXTEND_HELP)]
    Extend(Extend),
    /// Submit a job file with a sweep, wait for its end, extend it and submit that, in rounds
    #[command(after_help = RUN_HELP)]
    Run(SweepRun),
}

#[derive(Args)]
pub struct WhichSweep {
    /// Folder or URL of the store (in which data sets and models lie)
    #[arg(value_parser = crate::args::location::parse)]
    pub store: String,
    /// Name of the sweep: that of the model which it is about
    pub name: String,
    /// Which sweep of that name, where there are several: the first digits of its id
    #[arg(long, value_name = "ID", default_value = "")]
    pub id: String,
}

/// Who chooses values.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Sampler {
    /// By what was found: the tree-structured Parzen estimator; at random until 10 trials have
    /// ended
    Tpe,
    /// At random
    Random,
}

/// Which sweep gets further trials, and who chooses them.
#[derive(Args)]
pub struct MoreTrials {
    /// The job file, or the latest that was extended
    pub file: PathBuf,
    /// How many trials to add
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..1000))]
    pub trials: u64,
    /// Who chooses their values
    #[arg(long, value_enum, default_value_t = Sampler::Tpe)]
    pub sampler: Sampler,
    /// The stage with the sweep, where the job has several
    #[arg(long, value_name = "NAME")]
    pub stage: Option<String>,
    /// Which of the sizes that the file has: the values of its [scale.NAME]
    #[arg(long, value_name = "NAME")]
    pub scale: Option<String>,
}

#[derive(Args)]
pub struct Extend {
    #[command(flatten)]
    pub more: MoreTrials,
    /// The name that the best model gets [default: MODEL-TRIALS, e.g. depth-40]
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
    /// How many times to extend it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..1000))]
    pub rounds: u32,
}
