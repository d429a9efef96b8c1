//! What the test binaries share.
#![allow(
    dead_code,
    unused_imports,
    reason = "each test binary uses a part of this"
)]

pub mod mat;
pub mod npy;
pub mod room;
mod scene;
pub mod tricky;

pub use scene::*;
