//! Tests of the calibration, in one executable because each one links the renderer.

mod common;
mod doubts;
mod laws;
