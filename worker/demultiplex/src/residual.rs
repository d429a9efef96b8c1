//! How well depths and masks explain a histogram: the peaks of lit spots against the times that
//! geometry predicts. No truth is required.

use serde::Serialize;

use crate::{Capture, Demultiplexed};

/// Probabilities of light from which a spot's peak is looked for, and from which another spot's
/// peak may be taken for it.
const LIT: f32 = 0.7;
const MAY_BE_LIT: f32 = 0.3;
/// Confidence of the depth from which a pixel takes part.
const SURE: f32 = 0.6;
/// Half widths of the window in which a peak is looked for, metres of path, at least 3 bins. On a
/// desk, the light of all spots comes within decimetres, so only a narrow window has one peak.
const WINDOWS_M: [f64; 3] = [0.12, 0.06, 0.03];
/// The number of pairs from which no narrower window is tried.
const ENOUGH: usize = 400;
/// Spots closer than this number of windows are not told apart.
const APART: f64 = 1.5;
/// Windows by which the control's times are shifted.
const SHIFT: f64 = 3.0;
/// The approximate greatest number of pixels that take part.
const PIXELS: usize = 4096;

/// How far peaks are from the times that depth and spots predict.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Residual {
    /// The number of compared pairs of a pixel and a spot.
    pub peaks: usize,
    /// The median distance of the brightest bin's centre of light from the predicted time, metres
    /// of path.
    pub median_m: f64,
    /// The same at shifted times, where no peak is predicted: what wrong depths would have.
    pub control_m: f64,
}

/// Compares the peaks of a histogram with the times of what was found in it. A pixel has one depth,
/// and a peak for each spot that lights it, so that wrong depths do not pass. Only pairs take part
/// whose spot is lit and has no other's light near. Returns `None` if no pair is left.
pub fn residual(capture: &Capture, found: &Demultiplexed) -> Option<Residual> {
    let mut best: Option<Residual> = None;
    for window_m in WINDOWS_M {
        let found = residual_within(capture, found, window_m);
        if found.map_or(0, |r| r.peaks) > best.map_or(0, |r| r.peaks) {
            best = found;
        }
        if best.is_some_and(|r| r.peaks >= ENOUGH) {
            break;
        }
    }
    best
}

fn residual_within(capture: &Capture, found: &Demultiplexed, window_m: f64) -> Option<Residual> {
    let pixels = capture.pixels();
    let bins = capture.gate.bins as usize;
    let per_bin = 1.0 / capture.gate.bin_width_m;
    let window = ((window_m * per_bin).ceil() as usize).max(3);
    let camera = capture.camera;
    let width = camera.intrinsics.width as usize;
    let stride = pixels.div_ceil(PIXELS).max(1);
    let (mut there, mut control) = (Vec::new(), Vec::new());
    for p in (stride / 2..pixels).step_by(stride) {
        if found.confidence[p] < SURE || found.mirror_probability[p] >= 0.5 {
            continue;
        }
        let h = &capture.histogram[p * bins..][..bins];
        let (u, v) = ((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
        let ray = camera.ray(u, v).normalized();
        let range = found.depth_m[p] / ray.dot(camera.forward);
        let x = camera.origin + ray * range;
        // Predicted times in bins, and whether light is sure.
        let times: Vec<(f64, bool)> = (0..found.places.len())
            .filter(|s| found.lit[s * pixels + p] >= MAY_BE_LIT)
            .filter_map(|s| {
                let place = found.places[s]?;
                let path = f64::from(place.path_m + (x - place.point).length() + range);
                let time = (path - capture.gate.start_m) * per_bin;
                Some((time, found.lit[s * pixels + p] >= LIT))
            })
            .collect();
        let clear = APART * window as f64;
        let free = |at: f64, own: Option<usize>| {
            let others = times.iter().enumerate().filter(|(k, _)| Some(*k) != own);
            others.into_iter().all(|(_, o)| (o.0 - at).abs() > clear)
        };
        for (k, (time, _)) in times.iter().enumerate().filter(|(_, t)| t.1) {
            if free(*time, Some(k)) {
                there.extend(off(h, *time, window));
            }
            let shifted = time + SHIFT * window as f64;
            if free(shifted, None) {
                control.extend(off(h, shifted, window));
            }
        }
    }
    let middle = |mut all: Vec<f64>| {
        all.sort_by(f64::total_cmp);
        let at = all.len() / 2;
        all.get(at).map(|m| m * capture.gate.bin_width_m)
    };
    let peaks = there.len();
    Some(Residual {
        peaks,
        median_m: middle(there)?,
        control_m: middle(control)?,
    })
}

/// Distance in bins from a time to the centre of light of the brightest bin near it and that bin's
/// neighbours. `None` if the window leaves the histogram or has no light.
fn off(h: &[f32], time: f64, window: usize) -> Option<f64> {
    let bin = time.floor();
    let first = (bin >= (window + 1) as f64).then(|| bin as usize - window)?;
    let part = h.get(first..first + 2 * window + 1)?;
    let mut brightest = 0;
    for (k, x) in part.iter().enumerate() {
        if *x > part[brightest] {
            brightest = k;
        }
    }
    let least = part.iter().copied().fold(f32::INFINITY, f32::min);
    let peak = first + brightest;
    let near = h.get(peak - 1..peak + 2)?;
    let (mut sum, mut weight) = (0.0, 0.0);
    for (k, x) in near.iter().enumerate() {
        let w = f64::from((x - least).max(0.0));
        sum += w * ((peak + k) as f64 - 0.5);
        weight += w;
    }
    (weight > 0.0).then(|| (sum / weight - time).abs())
}
