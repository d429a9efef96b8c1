//! The `extras` of canonical glTF, which contain the data that glTF itself cannot represent.
//!
//! - scene: [`SceneExtras`] under the key `picofarm`: name, label vocabulary, camera pose and
//!   intrinsics, laser beams and spots, provenance.
//! - node with a mesh: `label` (category name) and `instance` (instance id).
//! - material: [`MaterialExtras`] under the key `picofarm`: the exact BSDF, in addition to the
//!   standard parameters that other programs read.
//!
//! Files from other programs may define a laser in the extras of any node: `"laser_spots": 25` (a
//! grid over the camera's view, or `{"random": 16}`, or `{"at": [[x, y], …]}`) or
//! `"laser_directions": [[x, y, z], …]` in that node's frame.
//!
//! They may also define a material's reflectance by wavelength, in that material's extras (custom
//! properties in Blender):
//! `"spectrum": [{"nm": 532, "reflectance": 0.3}, {"nm": 905, "reflectance": 0.7}]`, by ascending
//! wavelength in nanometres. Partly metallic materials may have a `specular_reflectance` in
//! addition to each reflectance, for their conductor. Colour and BSDF remain those of the standard
//! parameters: only renders with a wavelength use a spectrum.
//!
//! Our own material extras are used as long as metalness and roughness are unchanged. If they were
//! edited, the BSDF and spectrum in our extras are ignored, and the importer adds a note. A
//! `spectrum` outside `picofarm` is always used, in our own files too.

use picofarm_settings::Spots;
use serde::{Deserialize, Serialize};

use crate::{Bsdf, Camera, Laser, Material, Provenance, SpectrumPoint, Vec3};

/// The version of the extras, raised when their meaning changes.
pub(crate) const FORMAT: u32 = 1;

/// All scene data except meshes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SceneExtras {
    pub(crate) format: u32,
    pub(crate) name: String,
    pub(crate) labels: Vec<String>,
    pub(crate) camera: Camera,
    pub(crate) laser: Laser,
    pub(crate) provenance: Provenance,
}

/// A material with all properties of our model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct MaterialExtras {
    pub(crate) bsdf: Bsdf,
    pub(crate) two_sided: bool,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) spectrum: Vec<SpectrumPoint>,
}

/// The properties that any program may define in a material's extras.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub(crate) struct StatedSpectrum {
    pub(crate) spectrum: Vec<SpectrumPoint>,
}

/// Extras of scenes and materials under our key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Keyed<T> {
    pub(crate) picofarm: T,
}

/// The extras of a node.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct NodeExtras {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) label: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) instance: Option<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) laser_spots: Option<Spots>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) laser_directions: Option<Vec<Vec3>>,
}

/// Metalness and roughness by which other programs know a BSDF: roughness = √α.
pub(crate) fn metallic_roughness(material: &Material) -> (f32, f32) {
    match material.bsdf {
        Bsdf::Diffuse { .. } => (0.0, 1.0),
        Bsdf::RoughConductor { alpha, .. } => (1.0, alpha.sqrt()),
        Bsdf::Mixed { alpha, weight, .. } => (weight, alpha.sqrt()),
        Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => (0.0, 0.0),
    }
}
