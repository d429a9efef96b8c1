//! Writes files in the layouts of others, without the code under test.

pub mod mat;
pub mod npy;
pub mod room;
