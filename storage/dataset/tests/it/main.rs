//! Tests of data sets and stores, in one executable because each one links the whole crate.

mod common;
mod export;
mod faults;
mod flips;
mod format;
mod import_captures;
mod import_npy;
mod import_outside;
mod import_sb3d;
mod import_two_bounce;
mod integrity;
mod interop;
mod kills;
mod model_care;
mod models;
mod old_formats;
mod places;
mod predictions;
mod profiles;
mod publish;
mod render_group;
mod round_trip;
mod subsets;
mod verify;
mod wavelengths;
