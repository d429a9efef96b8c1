//! Whether any calibration that was tried explains the times. If none does, the one that came
//! nearest is a guess, and nothing is corrected.

use crate::{
    causes::{Findings, Found, continuous, discrete},
    hypotheses::apart,
    numeric::quantile,
    report::{Cause, Fault},
};

/// Share of times within one bin below which a calibration explains nothing: wrong calibrations of
/// nine and more spots come to 0.31 by chance.
const EXPLAINED: f64 = 0.35;
/// Fewest returns of one bounce that deny a calibration.
const RETURNS: usize = 3;
/// Distance of the median return from its spot that denies a calibration, pixels and share of the
/// image's columns.
const APART: [f64; 2] = [3.0, 0.04];
/// Distance that stands for a spot behind the camera, in images.
const BEHIND: f64 = 2.0;

/// A capture whose times no calibration explains.
pub(crate) struct Failed {
    pub cause: Cause,
    /// The corrections that came nearest.
    pub guesses: Vec<Cause>,
}

/// Returns why the refined calibration of a capture with a histogram for each spot explains
/// nothing; `None` if it explains the times.
pub(crate) fn failed(f: &Findings) -> Option<Failed> {
    f.m.per_spot?;
    let share = f.refined.fitted.agreeing;
    let percent = 100.0 * share;
    let pixels = distance(f);
    let columns = f.base.columns as f64;
    let most = APART[0].max(APART[1] * columns);
    let (value, unit, finding) = if share < EXPLAINED {
        let what = format!(
            "no correction explains the times: only {percent:.0} % of the two-bounce times agree with any calibration that was tried; a right one explains 40 % and more"
        );
        (share, "share of times", what)
    } else {
        let pixels = pixels.filter(|d| *d > most)?;
        let what = format!(
            "no correction explains the times and the returns: {percent:.0} % of the two-bounce times agree, but half of the returns of one bounce are {pixels:.1} pixels and more from their spots in the image; expected {most:.1} and less"
        );
        (pixels, "pixels", what)
    };
    let cause = Found {
        fault: Fault::Unexplained,
        wrong: true,
        value,
        error: 0.0,
        unit,
        finding,
        advice: "check by hand the camera (field of view, cx, cy), the order of rows and columns, the unit and axes of spots and laser, and t0: more than one of them is wrong, or the room moved",
        corrected: false,
    };
    let mut guesses = Vec::new();
    discrete(f, &mut guesses);
    continuous(f, &mut guesses);
    guesses.iter_mut().for_each(|g| g.corrected = false);
    Some(Failed {
        cause: cause.cause(),
        guesses,
    })
}

/// Median distance of returns of one bounce from their spots in the image, pixels; `None` with few
/// returns.
fn distance(f: &Findings) -> Option<f64> {
    let model = &f.refined.fitted.model;
    let mut all: Vec<f64> = f
        .observed
        .returns
        .iter()
        .enumerate()
        .filter_map(|(k, r)| {
            let far = BEHIND * model.columns as f64;
            Some(apart(model, k, r.as_ref()?.pixel).unwrap_or(far))
        })
        .collect();
    match all.len() < RETURNS {
        true => None,
        false => quantile(&mut all, 0.5),
    }
}
