//! A capture of all spots at once: it is taken apart with the stated calibration, and the peaks of
//! what was found are compared with its times.

use picofarm_demultiplex::{Capture, Demultiplexed, Settings, Shading, demultiplex, residual};

use crate::{
    CalibrateError, Measurement,
    fit::{Free, Observed},
    model::Model,
    observe::{ASSUMED, Seen, together},
    pixels::Pixels,
    times::Finder,
};

/// Rounds of taking the flash apart, each with the corrected calibration.
const ROUNDS: usize = 2;

/// Observes a capture of all spots. Only beams with stated spots can be compared, because the
/// places of others follow from the same histogram.
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
    let mut observed = None;
    for _ in 0..ROUNDS {
        let (found, _) = taken_apart(m, &model)?;
        for (beam, place) in model.beams.iter_mut().zip(&found.places) {
            if let (None, Some(place)) = (beam.point, place) {
                beam.range = f64::from(place.path_m);
            }
        }
        let seen: Observed = together(m, &found, &model, pixels, &finder);
        if placed(&model) {
            model = seen.fit(stated, Free::T0).model;
        }
        observed = Some(seen);
    }
    Ok(Seen {
        observed: observed.expect("at least one round"),
        pulse: None,
        samples: Vec::new(),
    })
}

/// Whether all spots have stated places.
pub(crate) fn placed(model: &Model) -> bool {
    model.beams.iter().all(|b| b.point.is_some())
}

/// Distance of peaks from the times that a calibration predicts, over that from shifted times; 1
/// without a pair to compare.
///
/// # Errors
/// Returns the errors of the method that takes the flash apart.
pub(crate) fn unclear(m: &Measurement, model: &Model) -> Result<f64, CalibrateError> {
    Ok(taken_apart(m, model)?.1)
}

/// Shifts of t0 and of the laser that a check must be able to see, bins and metres. Light of bins
/// narrower than the pulse does not tell a bin.
const SHIFT: ([f64; 2], f64) = ([1.0, 0.0384], 0.1);
/// Factor of the distance by which a shifted calibration must be worse.
const WORSE: f64 = 1.1;

/// Returns a wrong calibration with which the peaks agree as well as with this one, whose distance
/// is `share`.
///
/// # Errors
/// Returns the errors of the method that takes the flash apart.
pub(crate) fn as_good(
    m: &Measurement,
    model: &Model,
    share: f64,
) -> Result<Option<&'static str>, CalibrateError> {
    let ([bins, metres], laser) = SHIFT;
    let late = (bins * model.width).max(metres);
    let wrong = [
        ("a gate that begins a bin later", late, 0.0),
        ("a gate that begins a bin earlier", -late, 0.0),
        ("a laser 10 cm further right", 0.0, laser),
        ("a laser 10 cm further left", 0.0, -laser),
    ];
    for (name, late, right) in wrong {
        let mut shifted = model.clone();
        shifted.start += late;
        shifted.laser[0] += right;
        if unclear(m, &shifted)? < WORSE * share {
            return Ok(Some(name));
        }
    }
    Ok(None)
}

/// Takes the flash apart by rules, without learnt shadows.
fn taken_apart(m: &Measurement, model: &Model) -> Result<(Demultiplexed, f64), CalibrateError> {
    let all = vec![true; model.beams.len()];
    let spots = model.spots(m.capture.camera, m.capture.spots, &all);
    let capture = Capture {
        gate: model.gate(m.capture.gate.bins),
        laser: model.laser(m.capture.camera),
        spots: if placed(model) {
            &spots
        } else {
            m.capture.spots
        },
        ..m.capture
    };
    let settings = Settings {
        remove_pulse: false,
        shadows: Shading::Physics,
        ..Settings::default()
    };
    let found = demultiplex(&capture, &settings)?;
    let off = residual(&capture, &found);
    Ok((found, off.map_or(1.0, |r| r.median_m / r.control_m)))
}
