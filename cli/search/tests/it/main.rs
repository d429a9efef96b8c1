//! Tests of the search of sweeps, in one executable because each one links the whole crate.

mod objectives;
