//! Tests of reconstruction, in one executable because each one links the whole crate.

mod agreement;
mod bad_input;
mod baselines;
mod common;
mod doubt;
mod masks;
mod rays;
mod rooms;
mod same_bytes;
mod scale;
mod walls;
