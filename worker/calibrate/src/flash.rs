//! A capture of all spots at once: it is taken apart with the stated calibration, and the peaks of
//! what was found are compared with its times.

use picofarm_demultiplex::residual;

use crate::{
    CalibrateError, Measurement,
    fit::{Free, Observed},
    model::Model,
    observe::{ASSUMED, Seen, apart, together},
    pixels::Pixels,
    times::Finder,
};

/// Times that the flash is taken apart anew with what was corrected.
const ROUNDS: usize = 2;

/// Observes a capture of all spots.
///
/// # Errors
/// Returns the errors of the method that takes the flash apart.
pub(crate) fn observe(
    m: &Measurement,
    stated: &Model,
    pixels: &Pixels,
) -> Result<Seen, CalibrateError> {
    let finder = Finder::new(&ASSUMED, pixels.gain);
    let mut model = stated.clone();
    let mut observed: Option<Observed> = None;
    let mut unclear = None;
    for _ in 0..ROUNDS {
        let spots = model.spots(
            m.capture.camera,
            m.capture.spots,
            &vec![true; model.beams.len()],
        );
        let known = model.beams.iter().all(|b| b.point.is_some());
        let mut capture = m.capture;
        capture.gate = model.gate(capture.gate.bins);
        capture.laser = model.laser(capture.camera);
        if known {
            capture.spots = &spots;
        }
        let own = Measurement { capture, ..*m };
        let found = apart(&own)?;
        if unclear.is_none() {
            // Without a pair to compare, nothing is explained.
            let off = residual(&capture, &found);
            unclear = Some(off.map_or(1.0, |r| r.median_m / r.control_m));
        }
        for (beam, place) in model.beams.iter_mut().zip(&found.places) {
            if let (None, Some(place)) = (beam.point, place) {
                beam.range = f64::from(place.path_m);
            }
        }
        let seen = together(&own, &found, &model, pixels, &finder);
        if known {
            model = seen.fit(stated, Free::T0).model;
        }
        observed = Some(seen);
    }
    Ok(Seen {
        observed: observed.expect("at least one round"),
        pulse: None,
        samples: Vec::new(),
        unclear,
    })
}
