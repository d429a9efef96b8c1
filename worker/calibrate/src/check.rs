//! The check from end to end: pixels, observations, hypotheses, least squares, causes.

use crate::{
    CalibrateError, Measurement, Pulse, Report,
    causes::{Findings, report},
    correct::Corrected,
    evidence,
    fit::{Fitted, Free, Observed},
    hypotheses::{Chosen, Hypothesis, Turn, choose},
    masks,
    model::{FOCAL, LASER, Model, WIDTH},
    numeric::{length, sub},
    observe,
    pixels::Pixels,
    spots::locate,
    unexplained::failed,
    wide::{self, Coarse},
};

/// Least shifts of t0 in bins, of the laser and of each of its coordinates in metres, that are
/// corrected.
#[derive(Clone, Copy)]
pub(crate) struct Least {
    pub t0: f64,
    pub laser: f64,
    pub coordinate: f64,
    /// Share of the times that a shift of t0 alone must explain more, or share of the rms that it
    /// must save; `None` where returns with a known pulse tell t0.
    pub gain: Option<[f64; 2]>,
}

impl Least {
    pub const SHARP: Self = Self {
        t0: 0.25,
        laser: 0.006,
        coordinate: 0.004,
        gain: None,
    };
    /// Where the pulse is unknown, so that its peak is.
    pub const VAGUE: Self = Self {
        t0: 0.8,
        laser: 0.03,
        coordinate: 0.02,
        gain: Some([0.005, 0.03]),
    };
}

/// The same of relative focal length and bin width, and of a spot in metres.
pub(crate) const LEAST_FOCAL: f64 = 0.004;
pub(crate) const LEAST_WIDTH: f64 = 0.003;
pub(crate) const LEAST_SPOT: f64 = 0.03;
/// Distance of peaks from predicted times, over that from shifted times, above which a calibration
/// explains nothing of a capture of all spots at once.
pub(crate) const UNCLEAR: f64 = 0.15;
/// A shift counts from this many standard errors on.
pub(crate) const SIGNIFICANT: f64 = 5.0;
/// Standard error of a laser coordinate beyond which the laser is not estimated, metres.
const VAGUE_M: f64 = 0.02;
/// Share of the rms that a further parameter must save.
const SAVES: f64 = 0.03;
/// Fewest times that move t0 alone.
const FEWEST: usize = 100;
/// Share of the times that a shift of t0 may lose, if it saves rms.
const LOSS: f64 = 0.005;

/// Arrays for pictures of a check.
#[derive(Debug, Clone)]
pub struct Pictures {
    /// Distance of prediction and observation at each stored pixel with the stated calibration,
    /// metres of path, `[row][column]`: within which a third of the spots agree; NaN where no time
    /// is known.
    pub stated_m: Vec<f32>,
    /// The same with the corrected calibration.
    pub corrected_m: Vec<f32>,
    /// Share of a return's light in a bin, over the bin's middle minus the pulse's peak, bins. Bins
    /// are added up for a wide pulse, here and in `pulse`.
    pub pulse_samples: Vec<[f64; 2]>,
    /// The estimated pulse.
    pub pulse: Option<Pulse>,
}

/// The result of a check.
#[derive(Debug, Clone)]
pub struct Checked {
    /// Causes and verdict.
    pub report: Report,
    /// The corrected calibration.
    pub corrected: Corrected,
    /// Arrays for pictures.
    pub pictures: Pictures,
}

/// Checks a capture, and corrects its calibration. Returns the same bytes on any number of threads.
///
/// # Errors
/// Returns [`CalibrateError`] for an argument that cannot be used.
pub fn check(m: &Measurement) -> Result<Checked, CalibrateError> {
    m.check()?;
    let added = wide::factor(m);
    if added == 1 {
        return judge(m, 1, Pixels::new(m));
    }
    let coarse = Coarse::new(m, added);
    let part = coarse.measurement(m);
    let pixels = Pixels {
        // Sums of bins hide a ceiling of counts.
        ceiling: Pixels::new(m).ceiling,
        ..Pixels::new(&part)
    };
    let mut checked = judge(&part, added, pixels)?;
    coarse.restore(m, &mut checked);
    Ok(checked)
}

/// Checks a capture in whose histograms `added` bins were added up.
fn judge(m: &Measurement, added: usize, pixels: Pixels) -> Result<Checked, CalibrateError> {
    let stated = Model::new(&m.capture);
    let seen = match m.per_spot {
        Some(h) => observe::each(m, h, &pixels),
        None => crate::flash::observe(m, &stated, &pixels)?,
    };
    let (width, height) = (m.width(), m.pixels() / m.width());
    let chosen = match m.per_spot {
        Some(_) => choose(&stated, &seen.observed, width, height),
        None => Chosen {
            hypothesis: Hypothesis::stated(stated.beams.len()),
            share: 1.0,
            stated_share: 1.0,
            pixels: f64::NAN,
            stated_pixels: f64::NAN,
            rival: None,
        },
    };
    let h = &chosen.hypothesis;
    let observed = h.observed(&seen.observed, width, height);
    let base = h.model(&stated);
    let least = match seen.pulse {
        Some(_) => Least::SHARP,
        None => Least::VAGUE,
    };
    let (mut refined, mut relocated, mut unclear, mut as_good) = (None, Vec::new(), None, None);
    if m.per_spot.is_some() {
        let first = refine(&base, &observed, least, true);
        let (elsewhere, moved) = relocate(&first, &base, &observed);
        refined = Some(match elsewhere.is_empty() {
            true => first,
            false => refine(&moved, &observed, least, true),
        });
        relocated = elsewhere;
    } else if crate::flash::placed(&base) {
        let first = refine(&base, &observed, least, false);
        let share = crate::flash::unclear(m, &first.fitted.model)?;
        unclear = Some(share);
        if share < UNCLEAR {
            as_good = crate::flash::as_good(m, &first.fitted.model, share)?;
        }
        // What explains nothing corrects nothing.
        refined = Some(first).filter(|_| share < UNCLEAR);
    } else {
        unclear = Some(crate::flash::unclear(m, &base)?);
    }
    let refined = refined.unwrap_or_else(|| keep(&base, &observed, least));
    let masks = m.masks.map(|masks| {
        let (model, ranges) = (&refined.fitted.model, &refined.fitted.ranges);
        let order = |pixels| masks::order(model, &observed, ranges, masks, m.pixels(), pixels);
        // Masks are stored as the histograms are, or already turned.
        let (own, turned) = (order(&seen.observed.pixels), order(&observed.pixels));
        if turned.contrast > own.contrast {
            (turned, true)
        } else {
            (own, false)
        }
    });
    let mut placed = stated.clone();
    let bins: Vec<_> = seen
        .observed
        .returns
        .iter()
        .map(|r| r.map(|r| r.bin))
        .collect();
    placed.place_beams(&bins);
    let before = seen.observed.judged(placed.clone(), [0.0; 6], 0.0);
    let mut findings = Findings {
        m,
        pixels: &pixels,
        seen: &seen,
        observed: &observed,
        chosen: &chosen,
        base: &base,
        before: &before,
        refined: &refined,
        relocated: &relocated,
        masks: masks.as_ref(),
        unclear,
        evidence: evidence::measure(m, &seen.observed, &pixels.good()),
        as_good,
        failed: None,
        added,
    };
    // What explains nothing corrects nothing.
    let failed = failed(&findings);
    let kept = keep(&placed, &seen.observed, least);
    let unchanged = Chosen {
        hypothesis: Hypothesis::stated(stated.beams.len()),
        share: chosen.stated_share,
        pixels: chosen.stated_pixels,
        stated_share: chosen.stated_share,
        stated_pixels: chosen.stated_pixels,
        rival: None,
    };
    if failed.is_some() {
        findings = Findings {
            observed: &seen.observed,
            chosen: &unchanged,
            base: &placed,
            refined: &kept,
            relocated: &[],
            masks: None,
            failed: failed.as_ref(),
            ..findings
        };
    }
    let pictures = Pictures {
        stated_m: image(&before, &seen.observed, &seen.observed.pixels, m.pixels()),
        corrected_m: image(
            &findings.refined.fitted,
            findings.observed,
            &seen.observed.pixels,
            m.pixels(),
        ),
        pulse_samples: seen.samples.clone(),
        pulse: seen.pulse,
    };
    let report = report(&findings);
    let corrected = Corrected::new(&findings, &report.causes);
    Ok(Checked {
        report,
        corrected,
        pictures,
    })
}

/// A calibration refined by least squares.
pub(crate) struct Refined {
    pub fitted: Fitted,
    pub free: Free,
    /// Whether t0 moved by more than chance.
    pub t0: bool,
    /// Standard errors with all of t0 and laser free.
    pub errors: [f64; 4],
    /// Correlation of t0 and laser.
    pub tied: f64,
    /// Whether laser and t0 can be separated.
    pub separable: bool,
    /// What counts as a shift.
    pub least: Least,
}

impl Refined {
    /// Whether any parameter differs from the stated one.
    pub fn moved(&self) -> bool {
        self.t0 || self.free != Free::T0
    }
}

fn shift(fitted: &Fitted, base: &Model) -> [f64; 3] {
    sub(fitted.model.laser, base.laser)
}

/// Fits t0 and laser, then bin width and focal length if the times demand them. What moves by no
/// more than chance stays as stated.
///
/// Bin width and focal length are left alone without `lens`.
fn refine(base: &Model, seen: &Observed, least: Least, lens: bool) -> Refined {
    let mut free = Free::LASER;
    let mut best = seen.fit(base, free);
    let all = best.clone();
    let vague = LASER
        .iter()
        .any(|k| !(best.errors[*k] > 0.0 && best.errors[*k] < VAGUE_M));
    let separable = !vague;
    if vague {
        free = Free::T0;
        best = seen.fit(base, free);
    }
    let placed = base.beams.iter().all(|b| b.point.is_some());
    let worth = |tried: &Fitted, more: Free, than: &Fitted| {
        let focal = (tried.model.lens[0] / base.lens[0] - 1.0).abs();
        let width = (tried.model.width / base.width - 1.0).abs();
        let real = |on: bool, value: f64, least: f64, name: usize| {
            !on || value > least.max(SIGNIFICANT * tried.errors[name])
        };
        let better =
            tried.rms_m < (1.0 - SAVES) * than.rms_m || tried.agreeing > than.agreeing + 0.01;
        better
            && tried.agreeing > than.agreeing - 0.005
            && real(more.focal, focal, LEAST_FOCAL, FOCAL)
            && real(more.width, width, LEAST_WIDTH, WIDTH)
    };
    let plain = free;
    // One more parameter before two.
    for (focal, width) in [(true, false), (false, true), (true, true)] {
        if !lens || width && !placed {
            continue;
        }
        let more = Free {
            focal,
            width,
            ..plain
        };
        let tried = seen.fit(base, more);
        if worth(&tried, more, &best) {
            (free, best) = (more, tried);
        }
    }
    let moved = shift(&best, base);
    let far = length(moved) > least.laser;
    let mut held = free;
    for a in 0..3 {
        let sure = moved[a].abs() > least.coordinate.max(SIGNIFICANT * best.errors[LASER[a]]);
        held.laser[a] = free.laser[a] && far && sure;
    }
    if held != free {
        free = held;
        best = seen.fit(base, free);
    }
    if free.laser != [false; 3] && length(shift(&best, base)) < least.laser {
        free.laser = [false; 3];
        best = seen.fit(base, free);
    }
    let late = (best.model.start - base.start) / base.width;
    let mut t0 = late.abs() > least.t0.max(SIGNIFICANT * best.errors[0] / base.width);
    if free == Free::T0 {
        let mut model = base.clone();
        // Beams without a stated spot keep the ranges of the fit.
        model.beams.clone_from(&best.model.beams);
        let simple = seen.judged(model, best.errors, best.tied);
        // A shift that improves nothing is none.
        let gains = least.gain.is_none_or(|[share, saved]| {
            let more = best.agreeing > simple.agreeing + share;
            let sharper =
                best.agreeing > simple.agreeing - LOSS && best.rms_m < (1.0 - saved) * simple.rms_m;
            let times = seen.times.iter().flatten().flatten().count();
            times >= FEWEST && (more || sharper)
        });
        t0 &= gains || !lens;
        if !t0 {
            best = simple;
        }
    }
    Refined {
        fitted: best,
        free,
        t0,
        errors: [all.errors[0], all.errors[1], all.errors[2], all.errors[3]],
        tied: all.tied,
        separable,
        least,
    }
}

/// The calibration as stated.
fn keep(base: &Model, seen: &Observed, least: Least) -> Refined {
    Refined {
        fitted: seen.judged(base.clone(), [0.0; 6], 0.0),
        free: Free::T0,
        t0: false,
        errors: [0.0; 4],
        tied: 0.0,
        separable: true,
        least,
    }
}

/// A spot that is not where it is stated.
pub(crate) struct Relocated {
    pub spot: usize,
    pub distance: f64,
    pub error: f64,
    pub agreeing: [usize; 2],
}

/// Finds spots that are elsewhere, and returns the calibration with them moved. Only spots with a
/// return take part.
fn relocate(refined: &Refined, base: &Model, seen: &Observed) -> (Vec<Relocated>, Model) {
    let mut all = Vec::new();
    let fitted = &refined.fitted;
    let near = |k: usize| {
        let off = seen.residuals(&fitted.model, &fitted.ranges, k);
        let close = off
            .iter()
            .flatten()
            .filter(|e| e.abs() < fitted.model.width);
        close.count() as f64
    };
    let mut counts: Vec<f64> = (0..fitted.model.beams.len()).map(near).collect();
    let usual = crate::numeric::median(&mut counts).unwrap_or(0.0);
    for k in 0..fitted.model.beams.len() {
        let (Some(stated), Some(found)) = (
            fitted.model.beams[k].point,
            locate(&fitted.model, seen, &fitted.ranges, k),
        ) else {
            continue;
        };
        let distance = length(sub(found.point, stated));
        let least = LEAST_SPOT.max(SIGNIFICANT * found.error);
        let more = found.agreeing[1] as f64 > 1.25 * found.agreeing[0] as f64;
        // Light by way of a bright wall makes a few pixels agree on a spot that is not there.
        let enough = found.agreeing[1] as f64 > 0.4 * usual;
        if distance > least && more && enough {
            all.push((k, found, distance));
        }
    }
    // If most spots moved, it is not the spots that are wrong.
    if 3 * all.len() > fitted.model.beams.len() {
        return (Vec::new(), base.clone());
    }
    let mut model = base.clone();
    for (k, found, _) in &all {
        model.beams[*k].point = Some(found.point);
    }
    let made = all.into_iter().map(|(spot, found, distance)| Relocated {
        spot,
        distance,
        error: found.error,
        agreeing: found.agreeing,
    });
    (made.collect(), model)
}

/// Share of spots that light a pixel, at least: shadows have no residual.
const LIT: f64 = 0.33;

/// Residual of each stored pixel, of the spots that light it.
fn image(fitted: &Fitted, seen: &Observed, stored: &[usize], pixels: usize) -> Vec<f32> {
    let spots: Vec<_> = (0..seen.times.len())
        .map(|k| seen.residuals(&fitted.model, &fitted.ranges, k))
        .collect();
    let mut image = vec![f32::NAN; pixels];
    for (n, p) in stored.iter().enumerate() {
        let mut own: Vec<f64> = spots.iter().filter_map(|s| s[n]).map(f64::abs).collect();
        if let Some(middle) = crate::numeric::quantile(&mut own, LIT) {
            image[*p] = middle as f32;
        }
    }
    image
}

/// Whether nothing turned the image.
pub(crate) fn upright(turn: Turn) -> bool {
    turn == Turn::default()
}
