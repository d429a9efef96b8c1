//! Arguments of `picofarm sweep …`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

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
        /// The page to write; the same as JSON lies beside it
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
}

#[derive(Args)]
pub struct WhichSweep {
    /// Folder or URL of the store (in which data sets and models lie)
    #[arg(value_parser = crate::paths::place)]
    pub store: String,
    /// Name of the sweep: that of the model which it is about
    pub name: String,
    /// Which sweep of that name, where there are several: the first digits of its id
    #[arg(long, value_name = "ID", default_value = "")]
    pub id: String,
}
