//! Measurements from given masks and from depth or two-bounce paths. Sources are a data set's
//! truth, the predictions of networks from one multiplexed histogram (Shoot-Bounce-3D, appendices C
//! and E: two-bounce times follow from depth by geometry), and the results of another instrument's
//! own processing.

use picofarm_demultiplex::room_factor;
use picofarm_scene::{Camera, Vec3};

use crate::{LeftOut, Measured, MeasuredSpot, NEAR_SPOT_SINE, ReconstructError};

/// The least difference between the path to a spot and its distance from the laser by which a
/// mirror reflected the beam, metres in a scene of the size of a room.
const FOLDED_M: f32 = 1e-2;

/// The depth and masks of one scene. Images are row-major, `[row][column]`.
#[derive(Debug, Clone, Copy)]
pub struct Given<'a> {
    /// The camera.
    pub camera: Camera,
    /// The laser's position, metres.
    pub laser: Vec3,
    /// The spots, by beam: position and path from the laser in metres; `None` if a beam hits
    /// nothing.
    pub spots: &'a [Option<(Vec3, f32)>],
    /// The indices of the beams in use, ascending.
    pub beams: &'a [u32],
    /// The source of two-bounce times.
    pub times: Times<'a>,
    /// 1 if lit, for each beam in use: `[beam][row][column]`.
    pub lit: &'a [u8],
    /// 1 if a mirror is visible. Such pixels are not used, because their light came by other paths.
    pub mirror: &'a [u8],
}

/// The source of two-bounce times.
#[derive(Debug, Clone, Copy)]
pub enum Times<'a> {
    /// Times are computed from the distance along each pixel's ray, metres; 0 or a non-finite value
    /// = nothing is visible.
    Range(&'a [f32]),
    /// Times were measured.
    Paths {
        /// The optical path of each beam in use, `[beam][row][column]`; 0 or a non-finite value =
        /// not measured.
        metres: &'a [f32],
        /// The width of the bins in which paths were measured, metres.
        bin_width_m: f32,
    },
}

/// Returns the measurements with the given masks. Times are the measured ones, or are computed by
/// geometry.
///
/// # Errors
/// [`ReconstructError::Invalid`] naming the input of a wrong size.
pub fn given(given: &Given<'_>) -> Result<Measured, ReconstructError> {
    let mut measured = Measured {
        camera: given.camera,
        laser: given.laser,
        spots: Vec::new(),
        tau: Vec::new(),
        lit: Vec::new(),
        used: Vec::new(),
        bin_width_m: match given.times {
            Times::Range(_) => 0.0,
            Times::Paths { bin_width_m, .. } => bin_width_m,
        },
        computed: matches!(given.times, Times::Range(_)),
        mirror: given.mirror.to_vec(),
        confidence: Vec::new(),
        unlit_range_m: Vec::new(),
        left_out: Vec::new(),
    };
    let pixels = measured.pixels();
    let images = given.beams.len() * pixels;
    let times = match given.times {
        Times::Range(metres) => ("times.range", metres.len(), pixels),
        Times::Paths { metres, .. } => ("times.paths", metres.len(), images),
    };
    for (field, found, expected) in [
        times,
        ("mirror", given.mirror.len(), pixels),
        ("lit", given.lit.len(), images),
    ] {
        if found != expected {
            let what = format!("has {found} values, expected {expected}");
            return Err(ReconstructError::invalid(field, what));
        }
    }
    let places = given.spots.iter().flatten();
    let factor = room_factor(places.map(|(point, _)| (*point - given.camera.origin).length()));
    for (image, (&number, lit)) in given
        .beams
        .iter()
        .zip(given.lit.chunks_exact(pixels.max(1)))
        .enumerate()
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
        // Two-bounce light cannot have a shorter path.
        let shortest = path_m + (point - given.camera.origin).length();
        for (p, &lit) in lit.iter().enumerate() {
            let ray = measured.ray(p);
            let near = ray.cross(to_spot).length() < NEAR_SPOT_SINE && ray.dot(to_spot) > 0.0;
            let (usable, path) = match given.times {
                // In shadow there is no path to measure.
                Times::Paths { metres, .. } => {
                    let path = metres[image * pixels + p];
                    let possible = path.is_finite() && path > shortest;
                    (lit == 0 || possible, path)
                }
                Times::Range(metres) => {
                    let range = metres[p];
                    let x = given.camera.origin + ray * range;
                    let away = (x - point).length();
                    let seen = range.is_finite() && range > 0.0 && away > 0.0;
                    (seen, path_m + away + range)
                }
            };
            let usable = usable && !near && given.mirror[p] == 0;
            let tau = if usable && lit != 0 { path } else { 0.0 };
            measured.tau.push(tau);
            measured.lit.push(u8::from(lit != 0));
            measured.used.push(u8::from(usable));
        }
        measured.spots.push(MeasuredSpot {
            beam,
            direction: (point - given.laser).normalized(),
            point,
            path_m,
            folded: (straight - path_m).abs() * factor > FOLDED_M,
        });
    }
    Ok(measured)
}
