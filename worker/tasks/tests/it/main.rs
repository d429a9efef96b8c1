//! Tests of the kinds of task, in one executable because each one links the whole crate.

mod common;
mod farm;
mod gpu;
mod imported;
mod infer;
mod kinds;
mod layers;
mod logs;
mod parts;
mod place;
mod render;
mod reprocess;
mod session;
mod shards;
mod sweep;
mod train;
