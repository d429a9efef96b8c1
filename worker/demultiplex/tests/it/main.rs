//! Tests of one flash taken apart, in one executable because each one links the whole crate.

mod bad_input;
mod common;
mod laws;
mod separate;
mod size_and_pulse;
