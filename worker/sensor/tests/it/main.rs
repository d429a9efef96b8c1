//! Tests of the sensor model, in one executable because each one links the whole crate.

mod chain;
mod common;
mod detector;
mod draws;
mod free_running;
mod image;
mod kernel;
mod resample;
mod scale;
mod settings;
mod spots;
