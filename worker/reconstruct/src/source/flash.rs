//! Measurements from one flash: a multiplexed histogram that physics took apart
//! ([`picofarm_demultiplex`]). Depth gives the two-bounce times, and the probability of light gives
//! the masks. Pairs of pixel and spot that the histogram does not decide are left unused.

use picofarm_demultiplex::{Capture, Demultiplexed};
use picofarm_scene::Camera;

use super::{Given, Times, given};
use crate::{LeftOut, Measured, ReconstructError};

/// The probabilities of light between which a pair of pixel and spot is not evidence.
const UNDECIDED: std::ops::Range<f32> = 0.3..0.7;

/// Returns the times and masks of a flash. `beams` has the index in the scene of each of the
/// capture's spots, ascending.
///
/// # Errors
/// [`ReconstructError::Invalid`] if the sizes of the two differ.
pub fn from_flash(
    capture: &Capture,
    found: &Demultiplexed,
    beams: &[usize],
) -> Result<Measured, ReconstructError> {
    let camera = *capture.camera;
    let pixels = capture.pixels();
    let range: Vec<f32> = found
        .depth_m
        .iter()
        .enumerate()
        .map(|(p, z)| z / along(&camera, p))
        .collect();
    let numbers: Vec<u32> = (0..found.places.len() as u32).collect();
    let spots: Vec<_> = found
        .places
        .iter()
        .map(|place| place.map(|place| (place.point, place.path_m)))
        .collect();
    let none = vec![0; pixels];
    let mut measured = given(&Given {
        camera,
        laser: capture.laser,
        spots: &spots,
        beams: &numbers,
        times: Times::Range(&range),
        lit: &found.mask(),
        mirror: found.mirror.as_deref().unwrap_or(&none),
    })?;
    for (k, spot) in measured.spots.iter_mut().enumerate() {
        let probability = &found.lit[spot.beam * pixels..][..pixels];
        for (used, p) in measured.used[k * pixels..][..pixels]
            .iter_mut()
            .zip(probability)
        {
            *used &= u8::from(!UNDECIDED.contains(p));
        }
        spot.beam = beams[spot.beam];
    }
    for left in &mut measured.left_out {
        *left = LeftOut {
            beam: beams[left.beam],
            why: "it has no return in the histogram".into(),
        };
    }
    Ok(measured)
}

/// Returns the z-depth per metre along a pixel's ray.
fn along(camera: &Camera, pixel: usize) -> f32 {
    let width = camera.intrinsics.width as usize;
    let (x, y) = ((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
    camera.ray(x, y).normalized().dot(camera.forward)
}
