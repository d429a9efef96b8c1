//! The code that runs each kind of task. A kind imports only modules below this folder, and no
//! other kind. [`picofarm_proto::spec::kinds`] documents the kinds.

mod calibrate;
pub mod demultiplex;
#[cfg(feature = "networks")]
mod evaluate;
pub mod export;
mod generate;
mod import;
#[cfg(feature = "networks")]
pub mod infer;
mod part;
#[cfg(feature = "networks")]
mod promote;
#[cfg(feature = "networks")]
mod python;
pub mod reconstruct;
mod render;
#[cfg(feature = "networks")]
pub mod report;
pub mod reprocess;
pub mod split;
#[cfg(feature = "networks")]
pub mod train;
mod verify;
#[cfg(not(feature = "networks"))]
mod without_networks;
