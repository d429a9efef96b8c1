//! Tests of data sets, in one executable because each one links the whole crate.

mod cached;
mod common;
mod faults;
mod flips;
mod format;
mod integrity;
mod interop;
mod kills;
mod places;
mod profiles;
mod publish;
mod render_group;
mod round_trip;
mod subsets;
mod verify;
mod wavelengths;
