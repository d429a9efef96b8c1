//! Measurements from one flash: a multiplexed histogram that physics took apart
//! ([`picofarm_demultiplex`]). Depth gives the two-bounce times, and the probability of light gives
//! the masks. What the histogram does not decide is left unused.

use picofarm_demultiplex::{Capture, Demultiplexed};
use picofarm_scene::Camera;

use super::{Given, Times, given};
use crate::{LeftOut, Measured, ReconstructError, unlit};

/// The probabilities of light between which a pair of pixel and spot is no evidence.
const UNDECIDED: std::ops::Range<f32> = 0.3..0.7;

/// Returns the times and masks of a flash. `beams` has the index in the scene of each of the
/// capture's spots, ascending.
///
/// # Errors
/// [`ReconstructError::Invalid`] if the sizes of the arguments differ.
pub fn from_flash(
    capture: &Capture,
    found: &Demultiplexed,
    beams: &[usize],
) -> Result<Measured, ReconstructError> {
    let camera = *capture.camera;
    let range: Vec<f32> = found
        .depth_m
        .iter()
        .enumerate()
        .map(|(p, z)| z / along(&camera, p))
        .collect();
    let numbers: Vec<u32> = (0..found.places.len() as u32).collect();
    if beams.len() != numbers.len() {
        let what = format!("has {} values, expected {}", beams.len(), numbers.len());
        return Err(ReconstructError::invalid("beams", what));
    }
    let spots: Vec<_> = found
        .places
        .iter()
        .map(|place| place.map(|place| (place.point, place.path_m)))
        .collect();
    let none = vec![0; capture.pixels()];
    let mut measured = given(&Given {
        camera,
        laser: capture.laser,
        spots: &spots,
        beams: &numbers,
        times: Times::Range(&range),
        lit: &found.mask(),
        // A mirror has its own depth. To leave it out costs more than its wrong shadows.
        mirror: &none,
    })?;
    let sure = Certainty {
        lit: &found.lit,
        confidence: &found.confidence,
        range: &range,
    };
    weigh(&mut measured, &numbers, &sure)?;
    for spot in &mut measured.spots {
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

/// How surely one flash decides depth and shadows.
#[derive(Debug, Clone, Copy)]
pub struct Certainty<'a> {
    /// Probability of light, `[beam][row][column]`.
    pub lit: &'a [f32],
    /// Confidence of the depth, `[row][column]`.
    pub confidence: &'a [f32],
    /// Distance along each pixel's ray, metres, `[row][column]`.
    pub range: &'a [f32],
}

/// Weighs measurements by what the histogram decides: pairs of pixel and spot whose probability of
/// light is near one half are left unused, and the confidence of the depth is kept. A pixel without
/// a lit pair has its distance all the same where the confidence allows. `beams` are those that the
/// measurements are of, in the order of `sure.lit`.
///
/// # Errors
/// [`ReconstructError::Invalid`] naming the argument of a wrong size.
pub fn weigh(
    measured: &mut Measured,
    beams: &[u32],
    sure: &Certainty<'_>,
) -> Result<(), ReconstructError> {
    let Certainty {
        lit,
        confidence,
        range,
    } = *sure;
    let pixels = measured.pixels();
    for (field, found, expected) in [
        ("lit", lit.len(), beams.len() * pixels),
        ("confidence", confidence.len(), pixels),
        ("range", range.len(), pixels),
    ] {
        if found != expected {
            let what = format!("has {found} values, expected {expected}");
            return Err(ReconstructError::invalid(field, what));
        }
    }
    for (k, spot) in measured.spots.iter().enumerate() {
        let image = beams.iter().position(|b| *b as usize == spot.beam);
        let Some(image) = image else {
            let what = format!("lacks beam {}, which is measured", spot.beam);
            return Err(ReconstructError::invalid("beams", what));
        };
        let used = &mut measured.used[k * pixels..][..pixels];
        for (used, p) in used.iter_mut().zip(&lit[image * pixels..]) {
            *used &= u8::from(!UNDECIDED.contains(p));
        }
    }
    measured.confidence = confidence.to_vec();
    // The sum of all spots does not show the first light of each.
    let unknown = vec![f32::NAN; measured.lit.len()];
    unlit::fill(measured, &unknown);
    for (p, range) in range.iter().enumerate() {
        let mirror = measured.mirror.get(p).is_some_and(|m| *m != 0);
        if !measured.unlit_range_m[p].is_finite() && measured.is_evident(p) && !mirror {
            measured.unlit_range_m[p] = *range;
        }
    }
    Ok(())
}

/// Returns the z-depth per metre along a pixel's ray.
fn along(camera: &Camera, pixel: usize) -> f32 {
    let width = camera.intrinsics.width as usize;
    let (x, y) = ((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
    camera.ray(x, y).normalized().dot(camera.forward)
}
