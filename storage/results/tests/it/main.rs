//! Tests of results in stores, in one executable because each one links the whole crate.

#[path = "../../../dataset/tests/it/common/mod.rs"]
mod common;
mod flips;
mod model_care;
mod models;
mod predictions;

/// Returns the pieces of a checkpoint.
pub fn pieces(all: &[&[u8]]) -> picofarm_results::Pieces {
    let all: Vec<bytes::Bytes> = all.iter().map(|piece| piece.to_vec().into()).collect();
    Box::new(all.into_iter())
}
