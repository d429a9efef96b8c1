//! The subcommands of `picofarm dataset`.

use std::path::PathBuf;

use clap::Subcommand;

use super::{
    DatasetExport, DatasetGc, DatasetImport, DatasetRepair, DatasetReport, DatasetReprocess,
    DatasetShow, DatasetSplit, DatasetVerify, Snapshot, ranges,
};

#[derive(Subcommand)]
pub enum Dataset {
    /// Summarise a data set
    Info {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
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
        #[arg(value_parser = crate::args::location::parse)]
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
