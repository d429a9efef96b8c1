//! Findings about pixels and counts, put into words.

use crate::{
    causes::{Findings, Found},
    geometry::earliest,
    numeric::median,
    report::{Cause, Fault, Verdict},
};

/// Share of dead or hot pixels from which on results are wrong.
const WRONG_DEAD: f64 = 0.2;
/// Shares of photons lost to pile-up that are named, and that make results wrong.
const PILE_UP: [f64; 2] = [0.02, 0.3];
/// Background over light, in the gate of the median pixel, likewise.
const BACKGROUND: [f64; 2] = [0.1, 0.7];
/// Share of times that agree from which on a background does not make results wrong.
const READ: f64 = 0.6;
/// Bins before the first light of a spot, at least, that show the background.
const FREE: f64 = 4.0;
/// Share of histograms with a bin at the ceiling that makes results wrong.
const WRONG_CLIPPED: f64 = 0.05;

/// Whether too few photons are left to judge times.
pub(crate) fn noisy(causes: &[Cause]) -> bool {
    causes.iter().any(|c| match c.fault {
        Fault::Background | Fault::Clipped => true,
        Fault::DeadPixels => c.severity == Verdict::Wrong,
        _ => false,
    })
}

/// Whether the gate has bins before the first light, which show the background.
pub(crate) fn judged(f: &Findings) -> bool {
    let model = &f.refined.fitted.model;
    let free = |path: f64| (path - model.start) / model.width >= FREE;
    // Without stated spots the histograms alone tell.
    f.pixels.dark_bins > 0 && earliest(model).is_none_or(free)
}

/// Background of the median pixel, counts per bin.
pub(crate) fn background(f: &Findings) -> f64 {
    let mut dark: Vec<f64> = f.pixels.dark.iter().map(|x| f64::from(*x)).collect();
    median(&mut dark).unwrap_or(0.0) / f.added as f64
}

/// Names dead, hot and clipped pixels, pile-up and background.
pub(crate) fn counting(f: &Findings, causes: &mut Vec<Cause>) {
    let p = f.pixels;
    let all = p.dead.len();
    let mut pixels = |fault, which: &[bool], what: &str, advice, worst: f64| {
        let count = which.iter().filter(|w| **w).count();
        if count > 0 {
            let share = count as f64 / all as f64;
            let first = which.iter().position(|w| *w).unwrap_or(0);
            let (row, column) = (first / f.m.width(), first % f.m.width());
            causes.push(
                Found {
                    fault,
                    wrong: share >= worst,
                    value: count as f64,
                    error: 0.0,
                    unit: "pixels",
                    finding: format!(
                        "{count} of {all} pixels ({:.1} %) {what}; the first is row {row}, column {column}",
                        100.0 * share
                    ),
                    advice,
                    corrected: true,
                }
                .cause(),
            );
        }
    };
    pixels(
        Fault::DeadPixels,
        &p.dead,
        match p.shade {
            _ if p.cut.is_some() => "have no light, as far as the gate reaches",
            true => "are dead: they lack even the background that the others have",
            false => {
                "have no light: they are dead, or in full shadow, and no background tells which"
            }
        },
        match p.cut.is_some() {
            true => "widen the gate before pixels are called dead",
            false => {
                "take what the nearest good pixels show instead; replace the sensor if many stay dark"
            }
        },
        WRONG_DEAD,
    );
    pixels(
        Fault::HotPixels,
        &p.hot,
        "are hot: most of their counts come before light can",
        "mask them; the nearest good pixels fill in",
        WRONG_DEAD,
    );
    // What the gate cuts off, or what sees nothing, is not dead.
    for dead in causes.iter_mut().filter(|c| c.fault == Fault::DeadPixels) {
        dead.severity = match dead.severity {
            Verdict::Wrong if p.cut.is_some() => Verdict::CannotTell,
            Verdict::Wrong if !p.counts => Verdict::Usable,
            other => other,
        };
    }
    if let Some((most, held)) = p.ceiling {
        let histograms = all * f.m.per_spot.map_or(1, |_| f.m.capture.spots.len());
        causes.push(
            Found {
                fault: Fault::Clipped,
                wrong: held as f64 > WRONG_CLIPPED * histograms as f64,
                value: held as f64,
                error: 0.0,
                unit: "bins",
                finding: format!("{held} bins hold exactly {most}, the greatest count: they are clipped"),
                advice: "measure with less light or wider counters; the lost counts cannot be restored",
                corrected: false,
            }
            .cause(),
        );
    }
    if let Some(pulses) = p.pulses
        && p.lost > PILE_UP[0]
    {
        let known = f.m.pulses.is_some();
        causes.push(
            Found {
                fault: Fault::PileUp,
                wrong: p.lost > PILE_UP[1],
                value: p.lost,
                error: 0.0,
                unit: "share of photons",
                finding: format!(
                    "pile-up hides {:.0} % of the median pixel's photons: {} {pulses} pulses{}",
                    100.0 * p.lost,
                    if known { "of" } else { "the brightest pixels stop at" },
                    if known { "" } else { ", one photon each" }
                ),
                advice: "measure with less light, below 5 % of the pulses; the rest is corrected after Coates (1968)",
                corrected: true,
            }
            .cause(),
        );
    }
    let dark = background(f) * (f.added * f.m.bins()) as f64;
    let share = dark / p.light.max(1e-300);
    // A gate that ends early holds little light of a capture whose times are good.
    let read = f.m.per_spot.is_some() && f.refined.fitted.agreeing > READ;
    if judged(f) && share > BACKGROUND[0] {
        causes.push(
            Found {
                fault: Fault::Background,
                wrong: share > BACKGROUND[1] && !read,
                value: background(f),
                error: 0.0,
                unit: "counts per bin",
                finding: format!(
                    "the background is {:.3} counts per bin, {share:.1} times the light of the median pixel over the gate",
                    background(f)
                ),
                advice: "darken the room, narrow the optical filter, or gate earlier; the mean is subtracted, its noise stays",
                corrected: true,
            }
            .cause(),
        );
    }
}
