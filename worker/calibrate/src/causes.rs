//! Findings put into words, with figures and severities.

use picofarm_settings::PS_PER_M;

use crate::{
    Measurement,
    check::{Refined, Relocated, SIGNIFICANT, UNCLEAR, upright},
    counting::{background, counting, judged},
    evidence::DENIED,
    fit::{Fitted, Observed},
    geometry::{geometry, late},
    hypotheses::{Chosen, SCALES, order_name},
    masks::MaskOrder,
    model::{FOCAL, LASER, Model, T0, WIDTH},
    numeric::{length, quantile, sub},
    observe::Seen,
    pixels::Pixels,
    report::{Agreement, Cause, Evidence, Fault, PulseFound, Report, SpotResidual, Verdict},
    unexplained::Failed,
};

/// t0 in bins, laser in metres, focal length and bin width relative, from
/// which on results are wrong.
const WRONG_T0: f64 = 2.0;
const WRONG_LASER: f64 = 0.05;
const WRONG_FOCAL: f64 = 0.03;
const WRONG_WIDTH: f64 = 0.015;

/// Everything that was found.
pub(crate) struct Findings<'a> {
    pub m: &'a Measurement<'a>,
    pub pixels: &'a Pixels,
    pub seen: &'a Seen,
    /// What was seen, under the chosen hypothesis.
    pub observed: &'a Observed,
    pub chosen: &'a Chosen,
    /// The calibration under the chosen hypothesis, and refined.
    pub base: &'a Model,
    pub before: &'a Fitted,
    pub refined: &'a Refined,
    pub relocated: &'a [Relocated],
    /// The order of masks, and whether they are stored already turned.
    pub masks: Option<&'a (MaskOrder, bool)>,
    /// Of a capture of all spots at once: distance of peaks from predicted times, over that from
    /// shifted times.
    pub unclear: Option<f64>,
    /// What the capture can show.
    pub evidence: Evidence,
    /// Of a capture of all spots at once: a wrong calibration with which the peaks agree as well.
    pub as_good: Option<&'static str>,
    /// Why no calibration explains the times.
    pub failed: Option<&'a Failed>,
    /// Bins of the capture in a bin here.
    pub added: usize,
}

/// Writes down one cause.
pub(crate) struct Found<'a> {
    pub fault: Fault,
    pub wrong: bool,
    pub value: f64,
    pub error: f64,
    pub unit: &'a str,
    pub finding: String,
    pub advice: &'a str,
    pub corrected: bool,
}

impl Found<'_> {
    pub fn cause(self) -> Cause {
        Cause {
            fault: self.fault,
            severity: if self.wrong {
                Verdict::Wrong
            } else {
                Verdict::Usable
            },
            finding: self.finding,
            value: self.value,
            error: self.error,
            unit: self.unit.into(),
            advice: self.advice.into(),
            corrected: self.corrected,
        }
    }
}

pub(crate) fn report(f: &Findings) -> Report {
    let mut causes = geometry(&f.m.capture);
    let late = late(&f.m.capture).filter(|_| f.pixels.cut.is_some_and(|cut| cut.late));
    // If the gate cuts the light, it may be the gate that is short.
    for cause in causes.iter_mut().filter(|c| late.as_ref() == Some(c)) {
        cause.severity = Verdict::CannotTell;
    }
    discrete(f, &mut causes);
    continuous(f, &mut causes);
    // Without any count, all pixels look dead.
    if f.m.capture.histogram.iter().any(|x| *x > 0.0) {
        let from = causes.len();
        counting(f, &mut causes);
        if f.failed
            .is_some_and(|failed| failed.cause.fault == Fault::Evidence)
        {
            without_light(&mut causes, from, f.m.pulses.is_some());
        }
    }
    causes.extend(equal(f.m));
    causes.extend(f.failed.map(|failed| failed.cause.clone()));
    // Without enough evidence, distance is no proof.
    if let Some(share) = f.unclear.filter(|s| *s > DENIED && f.failed.is_none()) {
        causes.push(
            Found {
                fault: Fault::Unexplained,
                wrong: true,
                value: share,
                error: 0.0,
                unit: "of the distance by chance",
                finding: format!("peaks are {share:.2} of the distance from the predicted times that they are from wrong ones; right calibrations have had {DENIED} and less"),
                advice: "check the stated spots, the camera and the unit of time together: more than one of them is wrong, or the room moved",
                corrected: false,
            }
            .cause(),
        );
    }
    let fitted = &f.refined.fitted;
    causes.sort_by_key(|c| std::cmp::Reverse(c.severity));
    let agreement = |fitted: &Fitted| Agreement {
        share: fitted.agreeing,
        rms_m: fitted.rms_m,
    };
    Report {
        verdict: causes
            .iter()
            .map(|c| c.severity)
            .max()
            .unwrap_or(Verdict::Good),
        causes,
        guesses: f.failed.map_or(Vec::new(), |failed| failed.guesses.clone()),
        notes: notes(f),
        evidence: f.evidence,
        stated: Some(agreement(f.before)),
        corrected: Some(agreement(fitted)),
        unclear: f.unclear,
        errors: Some(f.refined.errors),
        pulse: f.seen.pulse.map(|shape| PulseFound {
            shape,
            fwhm_ps: shape.fwhm_bins() * fitted.model.width * PS_PER_M,
        }),
        background: judged(f).then(|| background(f)),
        spots: (0..fitted.model.beams.len()).map(|k| spot(f, k)).collect(),
    }
}

/// Takes back what the counts of noise alone suggest: totals that are all alike are no pile-up, and
/// a background without light makes nothing wrong that could be right.
fn without_light(causes: &mut Vec<Cause>, from: usize, stated: bool) {
    let mut kept = causes.split_off(from);
    kept.retain(|c| c.fault != Fault::PileUp || stated);
    for cause in kept.iter_mut().filter(|c| c.fault == Fault::Background) {
        cause.severity = Verdict::Usable;
    }
    causes.append(&mut kept);
}

/// Names spots that have the same histograms: one file stands for two.
fn equal(m: &Measurement) -> Option<Cause> {
    let spots: Vec<&[f32]> = m.per_spot?.chunks(m.pixels() * m.bins()).collect();
    let lit = |h: &[f32]| h.iter().any(|x| *x > 0.0);
    for (k, h) in spots.iter().enumerate() {
        if let Some(j) = (0..k).find(|j| spots[*j] == *h).filter(|_| lit(h)) {
            let found = Found {
                fault: Fault::EqualHistograms,
                wrong: true,
                value: k as f64,
                error: 0.0,
                unit: "spot",
                finding: format!(
                    "spots {j} and {k} have the same histograms, count for count: one file stands for two spots"
                ),
                advice: "import the file of each spot, in the order of the spots",
                corrected: false,
            };
            return Some(found.cause());
        }
    }
    None
}

fn spot(f: &Findings, k: usize) -> SpotResidual {
    let fitted = &f.refined.fitted;
    let off = f.observed.residuals(&fitted.model, &fitted.ranges, k);
    let mut near: Vec<f64> = off
        .into_iter()
        .flatten()
        .filter(|e| e.abs() < fitted.model.width)
        .collect();
    let squares = near.iter().fold(0.0, |sum, e| sum + e * e);
    let (point, path) = fitted.model.spot(k);
    SpotResidual {
        times: near.len(),
        rms_m: (squares / near.len().max(1) as f64).sqrt(),
        median_m: quantile(&mut near, 0.5),
        return_m: f.observed.returns[k].map(|r| path + length(point) - fitted.model.path(r.bin)),
    }
}

pub(crate) fn discrete(f: &Findings, causes: &mut Vec<Cause>) {
    let (h, chosen) = (&f.chosen.hypothesis, f.chosen);
    let shares = format!(
        "{:.0} % of the two-bounce times agree, against {:.0} % as stated",
        100.0 * chosen.share,
        100.0 * chosen.stated_share
    );
    let returns = match chosen.pixels.is_finite() && chosen.stated_pixels.is_finite() {
        true => format!(
            ", and returns are {:.1} pixels from their spots, against {:.1}",
            chosen.pixels, chosen.stated_pixels
        ),
        false => String::new(),
    };
    let gain = chosen.share - chosen.stated_share;
    let mut add = |fault, finding, advice| {
        causes.push(
            Found {
                fault,
                wrong: true,
                value: gain,
                error: 0.0,
                unit: "share of times",
                finding,
                advice,
                corrected: true,
            }
            .cause(),
        );
    };
    if !upright(h.turn) {
        add(
            Fault::Image,
            format!("the image is {}: so {shares}{returns}", h.turn.name()),
            "turn the histograms, or the stated camera axes",
        );
    }
    if h.reordered() {
        add(
            Fault::SpotOrder,
            format!(
                "histograms and spots are {}: so {shares}{returns}",
                order_name(&h.order)
            ),
            "reorder the stated spots so that spot k belongs to histogram k",
        );
    }
    if h.scale > 0 {
        let (factor, reason) = SCALES[h.scale];
        add(
            Fault::TimeScale,
            format!(
                "times are {factor:.4} of what they should be ({reason}): multiplied by it, {shares}",
                factor = 1.0 / factor
            ),
            "state bin width and begin of the gate as metres of path: picoseconds times 0.000299792",
        );
    }
    if let Some((masks, _)) = f.masks
        && masks.order.iter().enumerate().any(|(k, j)| k != *j)
    {
        causes.push(
            Found {
                fault: Fault::MaskOrder,
                wrong: true,
                value: masks.contrast,
                error: 0.0,
                unit: "contrast",
                finding: format!(
                    "masks and spots are {}: light at a spot's own time differs by {:.2} between lit and dark pixels, against {:.2} as stated",
                    order_name(&masks.order),
                    masks.contrast,
                    masks.stated
                ),
                advice: "reorder the masks so that mask k belongs to spot k",
                corrected: true,
            }
            .cause(),
        );
    }
}

pub(crate) fn continuous(f: &Findings, causes: &mut Vec<Cause>) {
    let (r, base) = (f.refined, f.base);
    let model = &r.fitted.model;
    let errors = &r.fitted.errors;
    if r.t0 {
        let bin = base.width / f.added as f64;
        let late = (model.start - base.start) / bin;
        let ps = (model.start - base.start) * PS_PER_M;
        causes.push(
            Found {
                fault: Fault::TimeZero,
                wrong: late.abs() >= WRONG_T0 * f.added as f64,
                value: late,
                error: errors[T0] / bin,
                unit: "bins",
                finding: format!(
                    "t0 is off: the gate begins {:.2} bins ({:.1} ps) {} than stated, ± {:.2}",
                    late.abs(),
                    ps.abs(),
                    if late > 0.0 { "later" } else { "earlier" },
                    errors[T0] / bin
                ),
                advice: "add the shift to the begin of the gate; t0 refers to the pulse's peak",
                corrected: true,
            }
            .cause(),
        );
    }
    let moved = sub(model.laser, base.laser);
    if r.free.laser.iter().any(|l| *l) {
        let error = LASER.iter().map(|k| errors[*k].powi(2)).sum::<f64>().sqrt();
        let [x, y, z] = moved.map(|m| 100.0 * m);
        causes.push(
            Found {
                fault: Fault::Laser,
                wrong: length(moved) >= WRONG_LASER,
                value: length(moved),
                error,
                unit: "m",
                finding: format!(
                    "the laser is {:.1} cm from its stated place: {x:+.1} cm right, {y:+.1} cm down, {z:+.1} cm ahead, ± {:.2}",
                    100.0 * length(moved),
                    100.0 * error
                ),
                advice: "use the corrected place of the laser",
                corrected: true,
            }
            .cause(),
        );
    }
    let focal = model.lens[0] / base.lens[0] - 1.0;
    if r.free.focal {
        let columns = model.columns as f64;
        let degrees = |f: f64| 2.0 * libm::atan2(0.5 * columns, f).to_degrees();
        causes.push(
            Found {
                fault: Fault::FieldOfView,
                wrong: focal.abs() >= WRONG_FOCAL,
                value: focal,
                error: errors[FOCAL],
                unit: "relative focal length",
                finding: format!(
                    "the view is {:.1} degrees wide, not {:.1}: the focal length is {:+.1} %, ± {:.1}",
                    degrees(model.lens[0]),
                    degrees(base.lens[0]),
                    100.0 * focal,
                    100.0 * errors[FOCAL]
                ),
                advice: "use the corrected focal length, or calibrate the camera with a pattern",
                corrected: true,
            }
            .cause(),
        );
    }
    let width = model.width / base.width - 1.0;
    if r.free.width {
        causes.push(
            Found {
                fault: Fault::BinWidth,
                wrong: width.abs() >= WRONG_WIDTH,
                value: width,
                error: errors[WIDTH],
                unit: "relative",
                finding: format!(
                    "bins are {:.3} ps wide, not {:.3}: {:+.2} %, ± {:.2}",
                    model.width * PS_PER_M / f.added as f64,
                    base.width * PS_PER_M / f.added as f64,
                    100.0 * width,
                    100.0 * errors[WIDTH]
                ),
                advice: "calibrate the time-to-digital converter, or use the corrected width",
                corrected: true,
            }
            .cause(),
        );
    }
    for moved in f.relocated {
        causes.push(
            Found {
                fault: Fault::Spot,
                wrong: moved.distance >= 0.2,
                value: moved.distance,
                error: moved.error,
                unit: "m",
                finding: format!(
                    "spot {} is {:.1} cm from its stated place, ± {:.1}: {} times agree, against {}",
                    moved.spot,
                    100.0 * moved.distance,
                    100.0 * moved.error,
                    moved.agreeing[1],
                    moved.agreeing[0]
                ),
                advice: "use the corrected place of the spot",
                corrected: true,
            }
            .cause(),
        );
    }
}

fn notes(f: &Findings) -> Vec<String> {
    let mut notes = Vec::new();
    let returns = f.seen.observed.returns.iter().flatten().count();
    let spots = f.m.capture.spots.len();
    if f.m.per_spot.is_none() {
        notes.push("all spots were measured at once: mirrored images, other units, fields of view and the order of spots are not tried".into());
    } else if returns < spots {
        notes.push(format!(
            "{} of {spots} spots show no return of one bounce: it is outside of the gate, hidden, or cut off",
            spots - returns
        ));
    }
    if f.unclear.is_some_and(|share| share > UNCLEAR) {
        notes.push("the times were not used for a correction, because they agree with none".into());
    }
    if !f.refined.separable {
        notes.push(format!(
            "t0 and the laser's place cannot be told apart (correlation {:.2}): the laser is kept as stated",
            f.refined.tied
        ));
    }
    let placed = f.base.beams.iter().all(|b| b.point.is_some());
    if !placed {
        notes.push(
            "no spot has a stated place: a common scale of all lengths cannot be seen".into(),
        );
    }
    if !judged(f) {
        notes.push("the gate begins with light: background and hot pixels cannot be seen".into());
    }
    let padding = f.pixels.padding.iter().filter(|p| **p).count();
    if padding > 0 {
        notes.push(format!(
            "{padding} pixels at the edges have no count in whole rows or columns: they are taken for padding and stay empty"
        ));
    }
    if f.seen.pulse.is_none() {
        notes.push(format!(
            "no return shows the pulse: that of {:.2} bins is assumed",
            crate::observe::ASSUMED.fwhm_bins()
        ));
    }
    if f.added > 1 {
        notes.push(format!(
            "the pulse is many bins wide: {} bins each were added up for the check, and times agree within such a sum",
            f.added
        ));
    }
    notes.push(format!(
        "shifts below {:.2} bins of t0, {:.0} mm of the laser and {SIGNIFICANT} standard errors are not corrected",
        f.refined.least.t0 * f.added as f64,
        1e3 * f.refined.least.laser
    ));
    notes
}
