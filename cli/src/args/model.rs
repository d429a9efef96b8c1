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
}
