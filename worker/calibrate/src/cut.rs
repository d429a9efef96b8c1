//! Gates that cut the light: if most pixels still have light in the gate's last bins, or have it in
//! the first ones, then what is missing may be the reason for dark pixels and for times that agree
//! with nothing.

use rayon::prelude::*;

use crate::{
    causes::{Findings, Found, continuous, discrete},
    evidence::DENIED,
    report::{Cause, Fault, Verdict},
    unexplained::{Failed, unexplained},
};

/// The part of the gate that is its end, and the fewest bins of it.
const END: (usize, usize) = (32, 4);
/// The share of a pixel's mean light that its end of the gate has if the gate cuts it.
const LIGHT: f64 = 0.5;
/// The share of the pixels with light from which on the gate cuts that of the capture: by itself,
/// and if many pixels have no light.
const PIXELS: [f64; 2] = [0.4, 0.25];
/// The share of a pixel's bright bins in the others' brightness, from which light has come.
const COME: f32 = 0.25;
/// The standard errors from which on counts are light.
const SURE: f64 = 3.0;
/// The share of pixels without light that the gate explains, and that keeps a verdict.
const UNLIT: f64 = 0.2;
/// The factor of agreeing times by which a correction shows that it is none of the gate's.
const GAIN: f64 = 1.2;

/// Light that the gate cuts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cut {
    /// Whether at the gate's end; otherwise at its begin.
    pub late: bool,
    /// The share of the pixels with light that have it there.
    pub share: f64,
    /// The share of all pixels without light.
    pub unlit: f64,
}

/// The pixels' histograms of all spots, in the order of the image.
pub(crate) struct Lit<'a> {
    pub histogram: &'a [f32],
    pub bins: usize,
    /// A bright bin of each pixel.
    pub tops: &'a [f64],
    /// The background of each pixel, per bin, if bins before the light show it.
    pub dark: Option<&'a [f32]>,
    /// Photons for each unit.
    pub gain: f64,
}

impl Lit<'_> {
    /// Returns where the gate cuts the light; `None` if it does not.
    pub fn cut(&self) -> Option<Cut> {
        let (bins, end) = (self.bins, (self.bins / END.0).max(END.1));
        if bins < 4 * end {
            return None;
        }
        let found: Vec<[bool; 3]> = self
            .histogram
            .par_chunks(bins)
            .enumerate()
            .map(|(p, h)| self.pixel(p, h, end))
            .collect();
        let count = |k: usize| found.iter().filter(|f| f[k]).count() as f64;
        let lit = count(0);
        let share = [1, 2].map(|k| count(k) / lit.max(1.0));
        let late = share[1] >= share[0];
        let share = share[0].max(share[1]);
        let unlit = 1.0 - lit / found.len() as f64;
        let least = PIXELS[usize::from(unlit >= UNLIT)];
        (share >= least).then_some(Cut { late, share, unlit })
    }

    /// Returns whether a pixel has light, and whether in the first and the last bins.
    fn pixel(&self, p: usize, h: &[f32], end: usize) -> [bool; 3] {
        let top = self.tops[p] as f32;
        let mean = |part: &[f32]| {
            let sum: f64 = part.iter().map(|x| f64::from(x.min(top))).sum();
            sum / part.len().max(1) as f64
        };
        let dark = match self.dark {
            Some(dark) => f64::from(dark[p]),
            // A pixel without light in some part of the gate shows its background there.
            None => h.chunks_exact(end).map(mean).fold(f64::INFINITY, f64::min),
        };
        let sure = |light: f64, bins: usize| {
            let photons = light * bins as f64 * self.gain;
            photons > SURE * (photons.max(0.0) + dark * bins as f64 * self.gain).sqrt()
        };
        let bright = |x: &f32| *x >= dark as f32 + COME * (top - dark as f32) && *x > 0.0;
        let (Some(first), Some(last)) = (h.iter().position(bright), h.iter().rposition(bright))
        else {
            return [false; 3];
        };
        if !sure(mean(h) - dark, h.len()) {
            return [false; 3];
        }
        let here = |part: &[f32], all: &[f32]| {
            let own = mean(part) - dark;
            sure(own, part.len()) && own > LIGHT * (mean(all) - dark)
        };
        let bins = h.len();
        [
            true,
            here(&h[..end], &h[..=last]),
            here(&h[bins - end..], &h[first..]),
        ]
    }
}

/// Returns why a capture whose gate cuts the light does not show whether its calibration is right;
/// `None` if the gate cuts nothing, or the times tell all the same.
pub(crate) fn shortened(f: &Findings) -> Option<Failed> {
    let cut = f.pixels.cut?;
    let mut corrections = Vec::new();
    continuous(f, &mut corrections);
    let large = corrections.iter().any(|c| c.severity == Verdict::Wrong);
    let (fitted, before) = (f.refined.fitted.agreeing, f.before.agreeing);
    let chance = large && fitted < GAIN * before;
    let denied = f.unclear.is_some_and(|share| share > DENIED);
    if cut.unlit < UNLIT && !chance && !denied && unexplained(f).is_none() {
        return None;
    }
    let cause = Found {
        fault: Fault::Evidence,
        wrong: false,
        value: cut.share,
        error: 0.0,
        unit: "share of pixels",
        finding: format!(
            "the gate cuts the light: {:.0} % of the pixels with light have it in the gate's {} bins, and {:.0} % of all have none",
            100.0 * cut.share,
            if cut.late { "last" } else { "first" },
            100.0 * cut.unlit
        ),
        advice: match cut.late {
            true => {
                "measure or import with a gate that ends later: keep_m up to the longest path in the room"
            }
            false => "measure or import with a gate that begins before the first light",
        },
        corrected: false,
    };
    let mut guesses = Vec::new();
    discrete(f, &mut guesses);
    guesses.append(&mut corrections);
    guesses.iter_mut().for_each(|g| g.corrected = false);
    Some(Failed {
        cause: Cause {
            severity: Verdict::CannotTell,
            ..cause.cause()
        },
        guesses,
    })
}
