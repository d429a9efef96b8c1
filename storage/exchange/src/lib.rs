//! Data sets in the layouts of others: import and export.

mod export;
pub mod import;

pub use import::capture;

/// The message of a program built without the feature `formats`, and how to build one with it.
#[cfg(not(feature = "formats"))]
const WITHOUT_FORMATS: &str = "this picofarm was built without OpenEXR and HDF5";
#[cfg(not(feature = "formats"))]
const BUILD_WITH_FORMATS: &str = "build it with `cargo build --release --features formats`, or with `--features full` for everything";

pub use export::{ExportFormat, Exported, Exporter};
