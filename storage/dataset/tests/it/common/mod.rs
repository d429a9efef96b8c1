//! Builders of scenes and stores, shared by the tests of dataset, results and exchange.
#![allow(
    dead_code,
    unused_imports,
    reason = "each test binary uses a part of this"
)]

mod scene;
pub mod tricky;

pub use scene::*;
