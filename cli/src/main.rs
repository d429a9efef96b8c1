//! The `picofarm` binary.
fn main() {}
