//! Arguments of `just lab model`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

#[derive(Args)]
pub struct Model {
    /// What the network learns: decides its inputs and its loss
    #[arg(long, value_enum, default_value_t = Learns::Tof)]
    pub target: Learns,
    /// Which network
    #[arg(long, value_enum, default_value_t = Kind::Unet2d)]
    pub net: Kind,
    /// Bins of the histograms
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u64).range(1..=4096))]
    pub bins: u64,
    /// Channels of the first level; of all features (swinir)
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub width: u64,
    /// Levels, the bottleneck among them
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(2..=8))]
    pub levels: u64,
    /// Channels of a convolution before the first level; 0 = none
    #[arg(long, default_value_t = 0)]
    pub stem: u64,
    /// That convolution is a 1×1 one with a bias, without norm and ReLU
    #[arg(long, requires = "stem")]
    pub linear_stem: bool,
    /// Moments after the projection of time (unet2.5d)
    #[arg(long, default_value_t = 32)]
    pub time: u64,
    /// A projection of time for each stream instead of one for both (unet2.5d)
    #[arg(long)]
    pub separate_streams: bool,
    /// Groups of blocks (swinir)
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub groups: u32,
    /// Blocks of a group (swinir)
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub depth: u32,
    /// Heads of attention; they share the width (swinir)
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub heads: u32,
    /// Rows and columns of a window of attention (swinir)
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(2..=64))]
    pub window: u32,
    /// On a graphics processor, as `picofarm model devices` names it (a build with --features wgpu
    /// or cuda)
    #[arg(long, value_name = "NAME")]
    pub gpu: Option<String>,
    /// Say how far outputs and gradient are from those of the CPU in 32 bits, besides; takes a step
    /// there
    #[arg(long, requires = "gpu", conflicts_with = "record")]
    pub compare: bool,
    /// Numbers in which convolutions are computed
    #[arg(long, value_enum, default_value_t = Numbers::F32)]
    pub precision: Numbers,
    /// Rows and columns of the images
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub side: u64,
    /// Images a batch
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub batch: u64,
    /// Rounds; in each, every form takes its steps in turn, and medians count
    #[arg(long, default_value_t = 7, value_parser = clap::value_parser!(u64).range(1..))]
    pub rounds: u64,
    /// Steps of each form in a round
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: u64,
    /// Write weights, batch, outputs, gradients and the losses of 20 steps for other programs to
    /// compare with, and do not measure
    #[arg(long, value_name = "FILE", conflicts_with = "peer")]
    pub record: Option<PathBuf>,
    /// Another program that takes the same steps, e.g. "python3 tests/lab/peers/model_torch.py
    /// bench"; it is given the record's file as its last argument
    #[arg(long, value_name = "COMMAND")]
    pub peer: Vec<String>,
}

/// What a network learns.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Learns {
    /// Depth from histograms
    Tof,
    /// A spot's shadow, from histograms and its two-bounce times
    Shadow,
    /// Mirrors from histograms
    Specular,
}

/// Numbers in which convolutions are computed.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Numbers {
    /// 32 bits
    F32,
    /// Rounded to bfloat16
    Bf16,
}

/// A network.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Kind {
    /// Bins are channels
    Unet2d,
    /// Time is a dimension of the encoder
    #[value(name = "unet2.5d")]
    Unet25d,
    /// Bins are channels, attention within windows
    Swinir,
    /// A volume of features, flattened over time, and a network over those images
    Embeddings,
    /// The same with attention in the volume
    Nlost,
}
