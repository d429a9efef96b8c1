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
    /// List the models of a store, including trainings in progress
    List {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
    },
    /// List this machine's graphics processors, and compare a product, a convolution and gradients
    /// with the CPU's
    Devices,
    /// Show a model: network, origin, figures
    Show {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Name of the model
        name: String,
    },
    /// Export a model's weights as safetensors, which PyTorch reads
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
    /// Import weights that were trained elsewhere: safetensors with PyTorch's names
    #[command(after_help = IMPORT_HELP)]
    Import {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Name of the model
        name: String,
        /// The weights (safetensors)
        file: PathBuf,
        /// Data set of the store with the network's bins, gate and spots
        #[arg(long, value_name = "FOLDER")]
        dataset: String,
        /// TOML file with the fields of [stage.train] that describe the network (target, net,
        /// input, shadow, histogram, …)
        #[arg(long, value_name = "FILE")]
        settings: PathBuf,
    },
    /// Check manifests, objects, evaluations and checkpoints of models; exit code 6 if one is
    /// damaged
    Verify {
        /// Folder or URL of the store
        store: String,
        /// Names of models [default: all]
        names: Vec<String>,
    },
    /// Restore damaged objects of a model from equal bytes; name the job that makes the rest again
    #[command(after_help = REPAIR_HELP)]
    Repair {
        /// Folder or URL of the store
        store: String,
        /// Name of the model
        name: String,
        /// Only list what would be done
        #[arg(long)]
        dry_run: bool,
    },
    /// Delete a model with its evaluations and checkpoints
    #[command(after_help = REMOVE_HELP)]
    Remove {
        /// Folder or URL of the store
        store: String,
        /// Name of the model
        name: String,
        /// Delete it even if models or predictions depend on it, its manifest is unreadable, or its
        /// training runs
        #[arg(long)]
        force: bool,
        /// Only list what would be deleted, and what depends on it
        #[arg(long)]
        dry_run: bool,
    },
    /// Write a page about models, and its data as JSON: figures next to trivial and published ones,
    /// curves, pictures
    Report {
        /// Folder or URL of the store
        #[arg(value_parser = crate::args::location::parse)]
        store: String,
        /// Names of models; NAME* means all that begin with NAME [default: all]
        names: Vec<String>,
        /// Page to write, with its data as JSON next to it
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
