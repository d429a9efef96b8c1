//! Arguments of `picofarm model …`.

use std::path::PathBuf;

use clap::Subcommand;

#[derive(Subcommand)]
pub enum Model {
    /// List the models of a store, those that are still trained, too
    List {
        /// Folder or URL of the store (in which data sets lie)
        store: String,
    },
    /// Say what a model is, where it comes from and how good it is
    Show {
        /// Folder or URL of the store
        store: String,
        /// Name of the model
        name: String,
    },
    /// Write a model's weights to a file (safetensors), which PyTorch reads too
    Export {
        /// Folder or URL of the store
        store: String,
        /// Name of the model
        name: String,
        /// Where to write it [default: NAME.safetensors]
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Write a page about models, and the same as JSON beside it: figures beside trivial answers and published ones, curves,
    /// pictures, speed against error
    Report {
        /// Folder or URL of the store
        store: String,
        /// Names of models; a name that ends with * means all that begin so [default: all]
        names: Vec<String>,
        /// The page to write; the same as JSON lies beside it
        #[arg(long, value_name = "FILE", default_value = "report.html")]
        out: PathBuf,
        /// Title of the page
        #[arg(long, default_value = "Trained networks")]
        title: String,
        /// Scenes of each model to show
        #[arg(long, default_value_t = 2)]
        pictures: usize,
    },
}
