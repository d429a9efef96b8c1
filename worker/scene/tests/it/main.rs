//! Tests of scenes, formats and generated rooms, in one executable because each one links the whole
//! crate.

mod common;
mod compressed;
mod furnished;
mod glass;
mod gltf_materials;
mod hostile;
mod import;
mod meshes;
mod mitsuba;
mod mitsuba_blends;
mod mitsuba_collections;
mod mitsuba_spectra;
mod outside;
mod ply;
mod primitive;
mod round_trip;
mod strangers;
mod viewpoint;
