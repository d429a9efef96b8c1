//! Tests of import and export, in one executable because each one links the whole crate.

mod captures;
mod captures_of_tools;
mod captures_words;
#[path = "../../../dataset/tests/it/common/mod.rs"]
mod common;
mod consumer_nlos;
mod export;
mod files;
mod import_captures;
mod import_npy;
mod import_outside;
mod import_sb3d;
mod import_two_bounce;
mod resampled;
