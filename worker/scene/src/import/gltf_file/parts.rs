//! Cameras and lasers of a glTF file.

use std::path::Path;

use gltf::camera::Projection;
use picofarm_settings::Spots;

use crate::{
    Affine, Aim, Beam, Camera, Intrinsics, Laser, SceneError, Vec3,
    extras::NodeExtras,
    import::{complete::FileLaser, format_error},
};

/// The number of rows of a camera if the file has no resolution; callers resize it.
const DEFAULT_ROWS: u32 = 64;

/// Converts a perspective camera. The error is its fault.
pub(super) fn camera_of(to_world: &Affine, file: &gltf::Camera<'_>) -> Result<Camera, String> {
    let field = format!("cameras[{}]", file.index());
    let Projection::Perspective(lens) = file.projection() else {
        return Err(format!(
            "{field}: is orthographic; use a perspective camera"
        ));
    };
    let aspect = lens.aspect_ratio().unwrap_or(1.0);
    let half = libm::tan(f64::from(lens.yfov()) * 0.5) as f32;
    let width = (DEFAULT_ROWS as f32 * aspect).round();
    if !(half > 0.0 && half.is_finite() && (1.0..=65536.0).contains(&width)) {
        return Err(format!("{field}: yfov and aspectRatio must be positive"));
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
    Ok(Camera {
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
