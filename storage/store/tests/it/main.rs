//! Tests of object stores and of published results, in one executable because each one links the
//! whole crate.

mod published;
#[allow(dead_code, reason = "tests of other crates use the rest of it")]
mod tricky;
