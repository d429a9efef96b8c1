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
    /// Show where a scene came from: job, code version, seed, source
    Show(DatasetShow),
    /// Check a data set against its manifests; exit code 6 if it is damaged
    Verify(DatasetVerify),
    /// Make broken scenes again, and restore their damaged objects
    Repair(DatasetRepair),
    /// Pin the finished scenes under a name, and compare with them
    #[command(subcommand)]
    Snapshot(Snapshot),
    /// List or delete objects of killed workers that belong to no finished scene
    #[command(alias = "collect")]
    Gc(DatasetGc),
    /// Draw a contact sheet (PNG) of a data set or of reconstructions, and light in flight (GIF) of
    /// a data set
    Picture {
        /// Folder or URL of the data set, or of reconstructions
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Folder for the pictures
        #[arg(long, default_value = ".", value_name = "DIR")]
        out: PathBuf,
        /// Maximum number of rows of the contact sheet
        #[arg(long, default_value_t = 8, value_parser = ranges::rows)]
        rows: usize,
    },
    /// Write a page about reconstructions, and its data as JSON: errors of novel views, meshes,
    /// best and worst scene
    Report(DatasetReport),
    /// Measure every scene with a sensor, into another data set, without rendering; resumes if run
    /// again
    Reprocess(Box<DatasetReprocess>),
    /// Export a data set, or a part of it, in another format; resumes if run again
    Export(DatasetExport),
    /// Import Shoot-Bounce-3D's release, PlatoNeRF's or bounce-flash lidar captures, or .npy files;
    /// resumes if run again
    Import(Box<DatasetImport>),
    /// Divide scenes into training, validation and test; run again to add new scenes
    Split(DatasetSplit),
}
