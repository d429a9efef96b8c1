//! The surface as binary glTF: a scene with the camera and the laser of the measurement, for
//! viewers and for the importer of scenes.

use std::{collections::BTreeMap, sync::Arc};

use picofarm_scene::{
    Affine, Beam, Laser, Material, Mesh, Object, Provenance, Scene, export::glb_bytes_with_normals,
};

use super::Surface;
use crate::{Measured, ReconstructError, VERSION};

/// The reflectance of the surface: colour is not measured.
const GREY: f32 = 0.5;

impl Surface {
    /// Encodes the surface as binary glTF 2.0 in metres and the scene's axes, y up, with normals
    /// and a grey two-sided material. If the surface has no triangles, the file contains only the
    /// camera and the laser.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] if the measuring camera's axes are not orthonormal, or if the
    /// file would exceed the 4 GiB of a `.glb`.
    pub fn glb(&self, measured: &Measured) -> Result<Vec<u8>, ReconstructError> {
        let mesh = Mesh {
            name: "surface".into(),
            positions: self.positions.clone(),
            triangle_material: vec![0; self.triangles.len()],
            triangles: self.triangles.clone(),
            materials: vec![Material::diffuse("surface", [GREY; 3])],
            ..Mesh::default()
        };
        let object = Object {
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label: 0,
            name: "surface".into(),
        };
        let beam = |direction| Beam {
            direction,
            spot: None,
        };
        let scene = Scene {
            name: "reconstruction".into(),
            objects: match self.triangles.is_empty() {
                true => Vec::new(),
                false => vec![object],
            },
            labels: vec!["surface".into()],
            camera: measured.camera,
            laser: Laser {
                origin: measured.laser,
                beams: measured.spots.iter().map(|s| beam(s.direction)).collect(),
            },
            provenance: Provenance {
                source: VERSION.into(),
                seed: None,
                attribution: Vec::new(),
                notes: BTreeMap::new(),
            },
        };
        glb_bytes_with_normals(&scene)
            .map_err(|e| ReconstructError::invalid("mesh.glb", e.to_string()))
    }
}
