//! Arguments of `picofarm model …`.

use std::path::PathBuf;

use clap::Subcommand;

const IMPORT_HELP: &str = "\
The network of the settings must have the file's tensors, each in its shape; what does not fit is named, and nothing is
written. PyTorch's own files (.pth) become safetensors so, with torch and safetensors installed:
  python3 -c 'import sys, torch, safetensors.torch as s; d = torch.load(sys.argv[1], map_location=\"cpu\"); \
d = d.get(\"model_state_dict\", d); s.save_file({k: v.contiguous() for k, v in d.items()}, sys.argv[2])' IN.pth OUT.safetensors";

const REPAIR_HELP: &str = "\
An object of the manifest comes from another model of the store that has the same one (as a promoted model has its trial's),
from a checkpoint, or from the manifest itself. It is written only if its SHA-256 is the recorded one. Damaged evaluations,
checkpoints and speeds are deleted: jobs make them again. What is left is named (exit code 6), with the job to submit.";

const REMOVE_HELP: &str = "\
Refused while another model was trained with it, or a group of predictions was made with it; --force removes it all the same.
A removal that was interrupted goes on with the same command. It says what remains. Reports stay as they are.";

#[derive(Subcommand)]
pub enum Model {
    /// List the models of a store, those that are still trained, too
    List {
        /// Folder or URL of the store (in which data sets lie)
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
    },
    /// List this machine's graphics processors, and try each: a product, a convolution and its
    /// gradients against the CPU's
    Devices,
    /// Show a model: its network, origin and quality
    Show {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Name of the model
        name: String,
    },
    /// Write a model's weights to a file (safetensors), which PyTorch reads too
    Export {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Name of the model
        name: String,
        /// The file to write [default: NAME.safetensors]
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Take a network that was trained elsewhere into a store: weights by PyTorch's names, as
    /// safetensors
    #[command(after_help = IMPORT_HELP)]
    Import {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Name of the model
        name: String,
        /// The weights (safetensors)
        file: PathBuf,
        /// Data set of the store whose histograms the network knows: its bins, gate and spots
        #[arg(long, value_name = "FOLDER")]
        dataset: String,
        /// What the network is: a TOML file with the fields of [stage.train] (target, net, input,
        /// shadow, histogram, …)
        #[arg(long, value_name = "FILE")]
        settings: PathBuf,
    },
    /// Check models: manifest, size and SHA-256 of each object, evaluations, checkpoints (exit code
    /// 6 where something is broken)
    Verify {
        /// Folder or URL of the store
        store: String,
        /// Names of models [default: all]
        names: Vec<String>,
    },
    /// Restore damaged objects of a model, from bytes that have the recorded SHA-256; say which job
    /// makes the rest again
    #[command(after_help = REPAIR_HELP)]
    Repair {
        /// Folder or URL of the store
        store: String,
        /// Name of the model
        name: String,
        /// Only say what would be done
        #[arg(long)]
        dry_run: bool,
    },
    /// Delete a model: its manifest first, then its objects, evaluations and checkpoints
    #[command(after_help = REMOVE_HELP)]
    Remove {
        /// Folder or URL of the store
        store: String,
        /// Name of the model
        name: String,
        /// Also where models or predictions build on it, its manifest cannot be read, or it is
        /// still trained
        #[arg(long)]
        force: bool,
        /// Only say what would be deleted, and what builds on it
        #[arg(long)]
        dry_run: bool,
    },
    /// Write a page about models, and its data as JSON: figures next to trivial answers and
    /// published ones, curves, pictures, speed against error
    Report {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Names of models; a name that ends with * means all that begin so [default: all]
        names: Vec<String>,
        /// The page to write; the same data as JSON goes next to it
        #[arg(long, value_name = "FILE", default_value = "report.html")]
        out: PathBuf,
        /// Title of the page
        #[arg(long, default_value = "Trained networks")]
        title: String,
        /// Scenes of each model to show
        #[arg(long, default_value_t = 2, value_parser = super::ranges::pictures)]
        pictures: usize,
    },
}
