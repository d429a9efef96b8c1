//! The harness of the end-to-end tests: real `picofarm` processes on loopback ports, started, stopped, frozen and
//! killed; what they print, and what they leave in a store.
//!
//! Nothing here knows the insides of the program. A test waits for what can be seen from outside (status, events,
//! files, logs), never for a time. Each test has a folder of its own, which stays when the test fails.

pub mod binary;
pub mod cli;
pub mod cloud;
pub mod cluster;
pub mod farm;
pub mod flood;
pub mod http;
pub mod job;
pub mod mount;
pub mod poison;
pub mod ports;
pub mod postgres;
pub mod process;
pub mod proxy;
pub mod rng;
pub mod s3;
pub mod scratch;
pub mod shapes;
pub mod slurm;
pub mod store;
pub mod wait;

pub use cli::{Cli, Ended};
pub use cluster::Cluster;
pub use farm::Farm;
pub use job::Job;
pub use process::{Process, Signal};
pub use scratch::Scratch;
pub use slurm::Slurm;

/// The folder of the tests, as cargo says where it runs them. (As it was when they were built, it may be another checkout's: a
/// target folder may be kept.)
///
/// # Panics
/// Where neither cargo nor nextest runs this.
pub fn package() -> String {
    std::env::var("CARGO_MANIFEST_DIR").expect("cargo or nextest runs the tests")
}
