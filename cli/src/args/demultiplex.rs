//! The arguments of `demultiplex`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

#[derive(Args)]
pub struct Demultiplex {
    /// A Zarr group of `picofarm scene render` or `picofarm scene sense`; it is not changed
    pub render: PathBuf,
    /// Folder for the new Zarr group and picture.png (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Physics takes the sum of all spots apart. The others need the histogram of each spot:
    /// PlatoNeRF's matched filter, and bounce-flash lidar's likelihood ratio
    #[arg(long, value_enum, default_value_t = MethodArg::Physics)]
    pub method: MethodArg,
    /// Source of the spots' places: the calibration in RENDER, or each beam's one-bounce return
    #[arg(long, value_enum, default_value_t = PlacesArg::Given)]
    pub places: PlacesArg,
    /// How physics judges shadows: by a few rules, or by trees that were learnt from rendered rooms
    /// [default: learned]
    #[arg(long, value_enum)]
    pub shadows: Option<ShadowsArg>,
    /// Threads [default: all cores]
    #[arg(long, value_parser = super::ranges::threads)]
    pub threads: Option<usize>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MethodArg {
    Physics,
    MatchedFilter,
    Likelihood,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PlacesArg {
    Given,
    Returns,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ShadowsArg {
    Physics,
    Learned,
}
