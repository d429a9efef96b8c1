//! The harness of the end-to-end tests: starts, stops, freezes and kills real `picofarm` processes
//! on loopback ports, and reads their output and stores.
//!
//! The harness does not use internals of the program. A test waits for externally visible
//! conditions (status, events, files, logs), never for a fixed time. Each test has a folder of its
//! own, which is retained if the test fails.

pub mod batch;
pub mod binary;
pub mod browser;
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
pub mod rooms;
pub mod s3;
pub mod scratch;
pub mod shapes;
pub mod slurm;
pub mod store;
pub mod wait;
pub mod wheels;

pub use batch::Batch;
pub use browser::Browser;
pub use cli::{Cli, Ended};
pub use cluster::Cluster;
pub use farm::Farm;
pub use job::Job;
pub use process::{Process, Signal};
pub use rooms::Rooms;
pub use scratch::Scratch;
pub use slurm::Slurm;

/// Returns the folder of the tests, from the variable that cargo sets when it runs them. (The
/// folder known at build time may belong to another checkout, because a target folder may be
/// reused.)
///
/// # Panics
/// If neither cargo nor nextest runs this.
pub fn package() -> String {
    std::env::var("CARGO_MANIFEST_DIR").expect("cargo or nextest runs the tests")
}
