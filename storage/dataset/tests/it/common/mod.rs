//! Helpers shared by the test binaries.
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

/// Returns the pieces of a checkpoint.
pub fn pieces(all: &[&[u8]]) -> picofarm_dataset::Pieces {
    let all: Vec<bytes::Bytes> = all.iter().map(|piece| piece.to_vec().into()).collect();
    Box::new(all.into_iter())
}
