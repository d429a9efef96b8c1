//! Tests of the renderer, in one executable because each one links the whole crate.

#[path = "../../benches/stop/scenes.rs"]
mod bench_scenes;
mod bvh;
mod by_glass;
mod calibration;
mod caustics;
mod common;
mod contacts;
mod determinism;
mod edges;
mod fill_factor;
mod forecast;
mod glass;
mod glass_tracer;
mod hard_energy;
mod hard_geometry;
mod hard_mirrors;
mod hard_thin;
mod hostile;
mod imports;
mod independent;
mod independent_glass;
mod laws;
mod mirrors;
mod narrow_gates;
mod needles;
mod reference;
mod rough;
mod scale;
mod stop;
mod sums;
mod warnings;
mod wavelengths;
mod whole_image;
mod wide_beams;
