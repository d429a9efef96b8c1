//! Tests of networks and training, in one executable because each one links the whole crate.

mod answers;
mod architectures;
mod common;
mod evidence;
mod gpu;
mod operations;
mod optimiser;
mod precision;
mod segments;
mod training;
