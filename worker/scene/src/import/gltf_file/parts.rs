//! Cameras and lasers of a glTF file.

use std::path::Path;

use gltf::camera::Projection;
use picofarm_settings::Spots;

use crate::{
    Affine, Aim, Beam, Camera, Intrinsics, Laser, SceneError, Vec3,
    extras::NodeExtras,
    import::{
        complete::{FileLaser, bounds},
        format_error,
    },
};

use super::Walk;

/// The number of rows of a camera if the file has no resolution; callers resize it.
const DEFAULT_ROWS: u32 = 64;

/// Converts a perspective camera. The error is its fault.
pub(super) fn camera_of(to_world: &Affine, file: &gltf::Camera<'_>) -> Result<Camera, String> {
    let field = format!("cameras[{}]", file.index());
    let Projection::Perspective(lens) = file.projection() else {
        return Err(format!("{field}: expected a perspective camera"));
    };
    let aspect = lens.aspect_ratio().unwrap_or(1.0);
    let half = libm::tan(f64::from(lens.yfov()) * 0.5) as f32;
    placed(to_world, half, aspect)
        .ok_or_else(|| format!("{field}: yfov and aspectRatio must be positive"))
}

impl Walk<'_> {
    /// Returns the reason if the scene has no surface.
    pub(super) fn why_empty(&self) -> Option<&'static str> {
        let mut meshes = self.objects.iter().map(|(_, object)| &object.mesh);
        if meshes.any(|mesh| !mesh.triangles.is_empty()) {
            return None;
        }
        let noted = |key: &str| self.notes.contains_key(key);
        Some(if noted("masks") {
            "alpha masks cut away its whole surface; lower alphaCutoff in its materials"
        } else if noted("hidden") {
            "all its meshes are in nodes that are not visible; show them and export again"
        } else if self.points {
            "is a point cloud, which has no surface; export a mesh of triangles"
        } else if noted("dropped") {
            "has only lines, which have no surface; export a mesh of triangles"
        } else if self.document.meshes().len() > 0 {
            "no node of its scene has a mesh of triangles; add the mesh to the scene and export again"
        } else {
            "has no meshes; export a mesh with faces"
        })
    }

    /// Replaces orthographic cameras, which follow the others. Their pixels look along parallel
    /// lines, which those of a lidar do not.
    pub(super) fn parallel_cameras(&mut self) {
        let all = self.objects.iter().map(|(_, object)| object);
        let Some((lo, hi)) = bounds(all) else { return };
        for (name, to_world, half) in std::mem::take(&mut self.parallel) {
            self.note(
                "cameras",
                "orthographic ones are pinholes at the same place, with the same width of view at the middle of the \
                 objects; --look-from, --look-at and --fov change it",
            );
            let read = pinhole(&to_world, half, (lo + hi) * 0.5);
            self.cameras.push((name, read));
        }
    }
}

/// Returns the pinhole camera for an orthographic one: it sees the same width at the distance of
/// `middle`. `half` is half of the view's width and height. The error is a fault of the camera.
fn pinhole(to_world: &Affine, half: [f32; 2], middle: Vec3) -> Result<Camera, String> {
    let linear = &to_world.linear;
    let back = Vec3::new(linear[0][2], linear[1][2], linear[2][2]).normalized();
    let away = (to_world.translation - middle).dot(back);
    // From within the objects, the view is 90° wide at most.
    let distance = away.max(half[0]);
    placed(to_world, half[1] / distance, half[0] / half[1])
        .ok_or_else(|| "xmag and ymag of an orthographic camera must not be 0".into())
}

/// Returns a camera with half of its height at a distance of 1, and its width for its height;
/// `None` if these are unusable.
fn placed(to_world: &Affine, half: f32, aspect: f32) -> Option<Camera> {
    let width = (DEFAULT_ROWS as f32 * aspect).round();
    if !(half > 0.0 && half.is_finite() && (1.0..=65536.0).contains(&width)) {
        return None;
    }
    let column = |k: usize| {
        Vec3::new(
            to_world.linear[0][k],
            to_world.linear[1][k],
            to_world.linear[2][k],
        )
        .normalized()
    };
    let (height, width) = (DEFAULT_ROWS as f32, width as u32);
    let fx = width as f32 * 0.5 / (half * aspect);
    Some(Camera {
        intrinsics: Intrinsics {
            fx,
            fy: height * 0.5 / half,
            cx: width as f32 * 0.5,
            cy: height * 0.5,
            width,
            height: DEFAULT_ROWS,
        },
        origin: to_world.translation,
        right: column(0),
        down: -column(1),
        forward: -column(2),
    })
}

/// Returns the laser that a node's extras define.
pub(super) fn laser_of(
    path: &Path,
    to_world: &Affine,
    extras: &NodeExtras,
) -> Result<FileLaser, SceneError> {
    if let Some(directions) = &extras.laser_directions {
        let beams = directions
            .iter()
            .map(|&d| Beam {
                direction: to_world.direction(d).normalized(),
                spot: None,
            })
            .collect();
        return Ok(FileLaser::Beams(Laser {
            origin: to_world.translation,
            beams,
        }));
    }
    // The caller found one of the two.
    let spots = extras.laser_spots.clone().unwrap_or(Spots::Grid(0));
    // A file has no seed, so random positions are the same in every file.
    Aim::of(&spots, 0)
        .map(FileLaser::Spots)
        .map_err(|what| format_error(path, format!("laser_spots: {what}")))
}
