//! What the canonical glTF keeps in `extras`, where glTF itself has no words for it.
//!
//! - scene: [`SceneExtras`] under the key `picofarm`: name, label vocabulary, camera pose and
//!   intrinsics, laser beams and spots, provenance.
//! - node with a mesh: `label` (category name) and `instance` (instance id).
//! - material: [`MaterialExtras`] under the key `picofarm`: the exact BSDF, beside the standard
//!   parameters that other programs read.
//!
//! Files of other makers may state a laser in the extras of any node: `"laser_spots": 25` (a grid over the
//! camera's view, or `{"random": 16}`, or `{"at": [[x, y], …]}`) or `"laser_directions": [[x, y, z], …]` in that node's frame.
//!
//! They may also state what a material reflects by wavelength, in that material's extras (custom properties in Blender):
//! `"spectrum": [{"nm": 532, "reflectance": 0.3}, {"nm": 905, "reflectance": 0.7}]`, by ascending wavelength in nanometres.
//! Metals in part may have a `specular_reflectance` beside each reflectance, for their conductor. Colour and BSDF stay those of
//! the standard parameters: only renders of stated wavelengths look at a spectrum.
//!
//! Our own material extras count while metalness and roughness are as we wrote them. Where someone edited these, the
//! spectrum in our extras is left out with the BSDF, and a note says so. A `spectrum` outside `picofarm` always counts, in files
//! of ours too.

use picofarm_settings::Spots;
use serde::{Deserialize, Serialize};

use crate::{Bsdf, Camera, Laser, Material, Provenance, SpectrumPoint, Vec3};

/// Version of the extras, raised when their meaning changes.
pub(crate) const FORMAT: u32 = 1;

/// Everything about a scene that is not a mesh.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SceneExtras {
    pub(crate) format: u32,
    pub(crate) name: String,
    pub(crate) labels: Vec<String>,
    pub(crate) camera: Camera,
    pub(crate) laser: Laser,
    pub(crate) provenance: Provenance,
}

/// A material as this program knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct MaterialExtras {
    pub(crate) bsdf: Bsdf,
    pub(crate) two_sided: bool,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) spectrum: Vec<SpectrumPoint>,
}

/// What anyone may state in a material's extras.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub(crate) struct StatedSpectrum {
    pub(crate) spectrum: Vec<SpectrumPoint>,
}

/// The key under which scene and material extras lie.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Keyed<T> {
    pub(crate) picofarm: T,
}

/// Extras of a node.
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
