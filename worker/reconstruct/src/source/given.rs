//! Measurements from depth and masks that are given: a data set's truth, or what networks predict of one multiplexed
//! histogram (Shoot-Bounce-3D, appendices C and E: two-bounce times follow from depth by geometry).

use picofarm_scene::{Camera, Vec3};

use crate::{LeftOut, Measured, MeasuredSpot, NEAR_SPOT_SINE, ReconstructError};

/// Depth and masks of one scene. Images are row-major, `[row][column]`.
#[derive(Debug, Clone, Copy)]
pub struct Given<'a> {
    /// The camera.
    pub camera: Camera,
    /// Where the laser stands, metres.
    pub laser: Vec3,
    /// The spots, by beam: place and path from the laser in metres; `None` where a beam meets nothing.
    pub spots: &'a [Option<(Vec3, f32)>],
    /// The beams that are used, ascending.
    pub beams: &'a [u32],
    /// Distance along the ray, metres; 0 or not finite = nothing is seen.
    pub range_m: &'a [f32],
    /// 1 where lit, of each used beam: `[beam][row][column]`.
    pub lit: &'a [u8],
    /// 1 where a mirror is seen: such pixels take no part, since what light they show came by other ways.
    pub mirror: &'a [u8],
}

/// Times by geometry, and the masks as they are.
///
/// # Errors
/// [`ReconstructError::Invalid`] naming what has another size.
pub fn given(given: &Given<'_>) -> Result<Measured, ReconstructError> {
    let mut measured = Measured {
        camera: given.camera,
        laser: given.laser,
        spots: Vec::new(),
        tau: Vec::new(),
        lit: Vec::new(),
        used: Vec::new(),
        bin_width_m: 0.0,
        mirror: given.mirror.to_vec(),
        left_out: Vec::new(),
    };
    let pixels = measured.pixels();
    for (field, found, expected) in [
        ("range_m", given.range_m.len(), pixels),
        ("mirror", given.mirror.len(), pixels),
        ("lit", given.lit.len(), given.beams.len() * pixels),
    ] {
        if found != expected {
            let what = format!("has {found} values, expected {expected}");
            return Err(ReconstructError::invalid(field, what));
        }
    }
    for (&number, lit) in given
        .beams
        .iter()
        .zip(given.lit.chunks_exact(pixels.max(1)))
    {
        let beam = number as usize;
        let leave_out = |why: &str| LeftOut {
            beam,
            why: why.to_owned(),
        };
        let Some(spot) = given.spots.get(beam) else {
            let what = format!(
                "names beam {beam}, but there are {}, counted from 0",
                given.spots.len()
            );
            return Err(ReconstructError::invalid("beams", what));
        };
        let Some((point, path_m)) = *spot else {
            measured.left_out.push(leave_out("it meets no surface"));
            continue;
        };
        let straight = (point - given.laser).length();
        let to_spot = (point - given.camera.origin).normalized();
        for (p, &lit) in lit.iter().enumerate() {
            let (ray, range) = (measured.ray(p), given.range_m[p]);
            let near = ray.cross(to_spot).length() < NEAR_SPOT_SINE && ray.dot(to_spot) > 0.0;
            let seen = range.is_finite() && range > 0.0 && given.mirror[p] == 0;
            let x = given.camera.origin + ray * range;
            let usable = seen && !near && (x - point).length() > 0.0;
            let tau = match usable && lit != 0 {
                true => path_m + (x - point).length() + range,
                false => 0.0,
            };
            measured.tau.push(tau);
            measured.lit.push(u8::from(lit != 0));
            measured.used.push(u8::from(usable));
        }
        measured.spots.push(MeasuredSpot {
            beam,
            direction: (point - given.laser).normalized(),
            point,
            path_m,
            folded: (straight - path_m).abs() > 1e-2,
        });
    }
    Ok(measured)
}
