//! Whether any calibration that was tried explains the times. If none does, the one that came
//! nearest is a guess, and nothing is corrected.

use crate::{
    causes::{Findings, Found, continuous, discrete},
    cut::shortened,
    evidence::lacking,
    hypotheses::apart,
    numeric::quantile,
    report::{Cause, Fault, Verdict},
};

/// Times of wrong calibrations agree by chance: of each pixel's times about three, whatever the
/// number of spots. A calibration explains nothing below this number over that of spots, within
/// these bounds.
const BY_CHANCE: f64 = 3.2;
const EXPLAINED: [f64; 2] = [0.22, 0.5];
/// Share of times, and factor over the stated calibration's share, below which several large
/// corrections are not believed, and how many these are.
const DOUBTFUL: [f64; 2] = [0.5, 1.5];
const LARGE: usize = 2;
/// Fewest returns of one bounce that deny a calibration.
const RETURNS: usize = 3;
/// Distance of the median return from its spot that denies a calibration, pixels and share of the
/// image's columns.
const APART: [f64; 2] = [3.0, 0.04];
/// Distance that stands for a spot behind the camera, in images.
const BEHIND: f64 = 2.0;

/// Least mean offset of returns from their spots that tells a wrong principal point, pixels and
/// standard errors; the standard deviation of one return within its pixel.
const DRIFT: ([f64; 2], f64) = ([0.35, 3.5], 0.29);
/// Half a pixel and a margin, and the share of returns beyond it that tells the same.
const HALF: f64 = 0.6;
const MISSED: f64 = 0.4;
/// Returns further from their spots belong to others, pixels.
const OTHER: f64 = 2.0;
const BY_HAND: &str = "check by hand the camera (field of view, cx, cy), the order of rows and columns, the unit and axes of spots and laser, and t0: more than one of them is wrong, or the room moved";
const PRINCIPAL: &str = "check cx and cy by hand: the middle of the first pixel is at 0.5, so that a centred view has half of the columns and of the rows";

/// A capture whose times no calibration explains.
pub(crate) struct Failed {
    pub cause: Cause,
    /// The corrections that came nearest.
    pub guesses: Vec<Cause>,
}

/// Returns why nothing may be corrected: the capture shows too little, its gate cuts the light, or
/// nothing explains it.
pub(crate) fn failed(f: &Findings) -> Option<Failed> {
    lacking(f)
        .or_else(|| shortened(f))
        .or_else(|| unexplained(f))
}

/// Returns why the refined calibration of a capture with a histogram for each spot explains
/// nothing; `None` if it explains the times.
pub(crate) fn unexplained(f: &Findings) -> Option<Failed> {
    f.m.per_spot?;
    let share = f.refined.fitted.agreeing;
    let percent = 100.0 * share;
    let pixels = distance(f);
    let columns = f.base.columns as f64;
    let spots = f.m.capture.spots.len() as f64;
    let explained = (BY_CHANCE / spots).clamp(EXPLAINED[0], EXPLAINED[1]);
    let most = APART[0].max(APART[1] * columns);
    let mut corrections = Vec::new();
    continuous(f, &mut corrections);
    let large = corrections.iter().filter(|c| c.severity == Verdict::Wrong);
    // Several large corrections that explain little more than none are a fit of chance.
    let chance =
        share < DOUBTFUL[0] && share < DOUBTFUL[1] * f.before.agreeing && large.count() >= LARGE;
    let (value, unit, finding, advice) = if share < explained || chance {
        let what = format!(
            "no correction explains the times: only {percent:.0} % of the two-bounce times agree with any calibration that was tried, against {:.0} % as stated; wrong ones come to {:.0} % by chance",
            100.0 * f.before.agreeing,
            100.0 * explained
        );
        (share, "share of times", what, BY_HAND)
    } else if let Some(pixels) = pixels.filter(|d| *d > most) {
        let what = format!(
            "no correction explains the times and the returns: {percent:.0} % of the two-bounce times agree, but half of the returns of one bounce are {pixels:.1} pixels and more from their spots in the image; expected {most:.1} and less"
        );
        (pixels, "pixels", what, BY_HAND)
    } else {
        let [u, v] = drift(f).filter(|_| f.refined.moved())?;
        let what = format!(
            "no correction explains the times and the returns: {percent:.0} % of the two-bounce times agree, but the returns of one bounce are on average {u:+.2} columns and {v:+.2} rows from their spots in the image: the principal point is off"
        );
        let pixels = (u * u + v * v).sqrt();
        (pixels, "pixels", what, PRINCIPAL)
    };
    let cause = Found {
        fault: Fault::Unexplained,
        wrong: true,
        value,
        error: 0.0,
        unit,
        finding,
        advice,
        corrected: false,
    };
    let mut guesses = Vec::new();
    discrete(f, &mut guesses);
    guesses.append(&mut corrections);
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

/// Mean offset of returns of one bounce from their spots in the image, columns and rows, if it is
/// more than chance.
fn drift(f: &Findings) -> Option<[f64; 2]> {
    let model = &f.refined.fitted.model;
    let offsets = f.observed.returns.iter().enumerate().filter_map(|(k, r)| {
        let pixel = r.as_ref()?.pixel;
        let [x, y] = model.film(model.spot(k).0)?;
        let u = (pixel % model.columns) as f64 + 0.5 - x;
        let v = (pixel / model.columns) as f64 + 0.5 - y;
        (u * u + v * v < OTHER * OTHER).then_some([u, v])
    });
    let all: Vec<[f64; 2]> = offsets.collect();
    let n = all.len() as f64;
    let mean = [0, 1].map(|a| all.iter().map(|o| o[a]).sum::<f64>() / n);
    let ([least, errors], deviation) = DRIFT;
    let size = (mean[0] * mean[0] + mean[1] * mean[1]).sqrt();
    // A return's pixel holds its spot, wherever in the pixel a regular grid of spots may be.
    let missed = all.iter().filter(|o| o.iter().any(|x| x.abs() > HALF));
    let missed = missed.count() as f64 / n;
    (all.len() > RETURNS && missed > MISSED && size > least.max(errors * deviation / n.sqrt()))
        .then_some(mean)
}
