//! Whether a capture can show a fault at all: without enough light from enough places, agreement
//! and disagreement say nothing, and the verdict is "cannot tell".

use rayon::prelude::*;

use crate::{
    Measurement,
    causes::{Findings, Found, continuous, discrete},
    check::UNCLEAR,
    counting::{counting, noisy},
    fit::Observed,
    hypotheses::Rival,
    numeric::median,
    report::{Cause, Evidence, Fault, Verdict},
    unexplained::Failed,
};

/// Fewest spots: t0, the laser's place and as many returns leave nothing over to judge. Of 4 spots
/// a right calibration has been moved by 0.7 m.
const SPOTS: usize = 9;
/// Fewest pixels for a histogram of all spots.
const TOGETHER: usize = 400;
/// Distance of the peaks of all spots together from predicted times, over that from shifted times,
/// above which a calibration is wrong. Right ones have had up to 0.2 with 16 spots, 0.65 with 4.
pub(crate) const DENIED: f64 = 0.4;
/// Fewest times beyond the first of each pixel that can contradict a calibration.
const FEWEST: usize = 150;
/// Fewest pixels with at least two times.
const PIXELS: usize = 48;
/// Median difference of times of neighbouring pixels, over that of pixels far apart, above which
/// times do not follow surfaces: those of noise have 1.
const FOLLOWS: f64 = 0.6;
/// Median standard error of a time, bins, above which times disagree by noise.
const VAGUE_BINS: f64 = 0.4;
/// Share of the times by which the stated calibration must explain more than any wrong one.
const MARGIN: f64 = 0.04;
/// Or the factor, and the pixels, by which returns must be nearer to their spots.
const NEARER: (f64, f64) = (0.5, 1.0);

/// Measures what a capture can show.
pub(crate) fn measure(m: &Measurement, observed: &Observed, good: &[bool]) -> Evidence {
    let mut pixels = 0;
    let mut times = 0;
    for n in 0..observed.pixels.len() {
        let own = observed.times.iter().filter(|t| t[n].is_some()).count();
        pixels += usize::from(own > 1);
        times += own.saturating_sub(1);
    }
    let mut errors: Vec<f64> = observed
        .times
        .iter()
        .flatten()
        .flatten()
        .map(|t| t.error)
        .collect();
    Evidence {
        pixels,
        times,
        error_bins: median(&mut errors),
        neighbours: match m.per_spot {
            Some(_) => follows(observed, m.width()),
            None => brightest_bins(m.capture.histogram, m.bins(), m.width(), good),
        },
    }
}

/// Median difference of times of neighbouring pixels over that of pixels far apart.
fn follows(observed: &Observed, width: usize) -> Option<f64> {
    let n = observed.pixels.len();
    let place = |k: usize| (observed.pixels[k] % width, observed.pixels[k] / width);
    let (mut near, mut far) = (Vec::new(), Vec::new());
    for times in &observed.times {
        for a in 0..n {
            let add = |b: usize, to: &mut Vec<f64>| {
                if let (Some(x), Some(y)) = (times[a], times[b]) {
                    to.push((x.bin - y.bin).abs());
                }
            };
            if a + 1 < n {
                let ((u, v), (x, y)) = (place(a), place(a + 1));
                if v == y && u.abs_diff(x) <= 1 + width / 16 {
                    add(a + 1, &mut near);
                }
            }
            add((a + n / 2) % n, &mut far);
        }
    }
    if near.len() < FEWEST {
        return None;
    }
    // A tenth of a bin is the resolution of times.
    Some(median(&mut near)? / median(&mut far)?.max(0.1))
}

/// Returns what a capture lacks for a verdict on its calibration; `None` if it lacks nothing.
pub(crate) fn lacking(f: &Findings) -> Option<Failed> {
    let (finding, advice) = match f.m.per_spot {
        _ if f.m.capture.histogram.iter().all(|x| *x <= 0.0) => (
            "the histograms are empty".to_owned(),
            "see whether the laser was on, and whether the gate and the array are those of the measurement",
        ),
        Some(_) => separate(f)?,
        None => together(f)?,
    };
    let cause = Found {
        fault: Fault::Evidence,
        wrong: false,
        value: f.evidence.times as f64,
        error: 0.0,
        unit: "times",
        finding,
        advice,
        corrected: false,
    };
    let mut guesses = Vec::new();
    if f.evidence.times >= FEWEST {
        discrete(f, &mut guesses);
        continuous(f, &mut guesses);
    }
    guesses.iter_mut().for_each(|g| g.corrected = false);
    Some(Failed {
        cause: Cause {
            severity: Verdict::CannotTell,
            ..cause.cause()
        },
        guesses,
    })
}

const MORE: &str = "measure more spots and pixels, each spot in a histogram of its own";
const LIGHT: &str = "measure longer, or with more light: several tens of photons in the brightest bin of a usual pixel";

const APART: &str = "measure each spot in a histogram of its own: all spots together tell a right calibration from a wrong one only where their peaks are apart";

type Lack = Option<(String, &'static str)>;

/// What histograms of each spot lack.
fn separate(f: &Findings) -> Lack {
    let e = &f.evidence;
    let spots = f.m.capture.spots.len();
    if spots < SPOTS {
        let what = format!(
            "{spots} spot{} cannot tell a shift of t0 from one of the laser, or of the depths; at least {SPOTS} can",
            if spots == 1 { "" } else { "s" }
        );
        return Some((what, MORE));
    }
    if e.pixels < PIXELS || e.times < FEWEST {
        let what = format!(
            "only {} pixels have times of two spots and more, {} times that could contradict; at least {PIXELS} and {FEWEST} are needed",
            e.pixels, e.times
        );
        let small = f.m.pixels() < 2 * PIXELS;
        return Some((what, if small { MORE } else { LIGHT }));
    }
    if let Some(ratio) = e.neighbours.filter(|r| *r > FOLLOWS) {
        let what = format!(
            "times of neighbouring pixels differ {ratio:.2} times as much as those far apart (noise has 1, surfaces have less than {FOLLOWS}): they are those of noise, or pixels are in another order"
        );
        return Some((what, LIGHT));
    }
    let poor = crate::unexplained::unexplained(f).is_some();
    if let Some(error) = e.error_bins.filter(|x| poor && *x > VAGUE_BINS) {
        let what = format!(
            "times agree with no calibration that was tried, but their noise of {error:.2} bins (median standard error) may be the reason"
        );
        return Some((what, LIGHT));
    }
    let moved = f.refined.moved() || !f.relocated.is_empty();
    if poor || moved || f.chosen.hypothesis.faults() > 0 {
        return None;
    }
    if let Some(rival) = f.chosen.rival.as_ref().filter(|r| explains(r, f)) {
        let what = format!(
            "{} explains {:.0} % of the times, as stated explains {:.0} %",
            rival.name(),
            100.0 * rival.share,
            100.0 * f.chosen.stated_share
        );
        return Some((what, MORE));
    }
    if !f.refined.separable {
        let what = format!(
            "t0 and the laser's place cannot be told apart (correlation {:.2})",
            f.refined.tied
        );
        return Some((what, MORE));
    }
    None
}

/// Whether a wrong calibration explains about as much as the stated one.
fn explains(rival: &Rival, f: &Findings) -> bool {
    let as_good = rival.share > f.chosen.stated_share - MARGIN;
    let (ours, theirs) = (f.chosen.stated_pixels, rival.pixels);
    let denied = ours.is_finite() && ours < NEARER.0 * theirs && ours < theirs - NEARER.1;
    as_good && !denied
}

/// What a histogram of all spots lacks.
fn together(f: &Findings) -> Lack {
    let spots = f.m.capture.spots.len();
    if spots < SPOTS || f.m.pixels() < TOGETHER {
        let what = format!(
            "{spots} spots in one histogram of {} pixels show too few separate peaks; at least {SPOTS} spots and {TOGETHER} pixels do",
            f.m.pixels()
        );
        return Some((what, MORE));
    }
    if let Some(ratio) = f.evidence.neighbours.filter(|r| *r > FOLLOWS) {
        let what = format!(
            "the brightest bins of neighbouring pixels differ {ratio:.2} times as much as those far apart (noise has 1, surfaces have less than {FOLLOWS}): they are those of noise, or pixels are in another order"
        );
        return Some((what, LIGHT));
    }
    let share = f.unclear?;
    let mut counted = Vec::new();
    counting(f, &mut counted);
    if share > UNCLEAR && (share < DENIED || noisy(&counted)) {
        let what = format!(
            "peaks of all spots together are {share:.2} of the distance from the predicted times that they are from wrong ones; right calibrations have had up to {DENIED}, wrong ones from {UNCLEAR} on"
        );
        return Some((what, APART));
    }
    let rival = f.as_good.as_ref().filter(|_| share <= UNCLEAR)?;
    let what = format!("the peaks agree as well with {rival}");
    Some((what, APART))
}

/// Median difference of the brightest bins of neighbouring pixels over that of pixels far apart.
fn brightest_bins(h: &[f32], bins: usize, width: usize, good: &[bool]) -> Option<f64> {
    let peaks: Vec<Option<f64>> = h
        .par_chunks(bins)
        .enumerate()
        .map(|(p, h)| {
            let top = h.iter().copied().fold(0.0f32, f32::max);
            (good[p] && top > 0.0)
                .then(|| h.iter().position(|x| *x == top))?
                .map(|b| b as f64)
        })
        .collect();
    let n = peaks.len();
    let (mut near, mut far) = (Vec::new(), Vec::new());
    for p in 0..n {
        let pair = |q: usize| Some((peaks[p]? - peaks[q]?).abs());
        if (p + 1) % width != 0 {
            near.extend(pair(p + 1));
        }
        far.extend(pair((p + n / 2 + width / 2) % n));
    }
    if near.len() < FEWEST {
        return None;
    }
    // The mean, because the brightest spot changes between pixels.
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len() as f64;
    Some(mean(&near) / mean(&far).max(0.1))
}
