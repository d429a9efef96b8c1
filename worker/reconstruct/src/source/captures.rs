//! Measurements from K separate single-spot histograms, as in PlatoNeRF (its `src/run_platonerf.py`
//! and `utils/load_tof.py`; numbers in the code are the steps of its preprocessing).
//!
//! Three steps differ: a time is the **middle** of its bin (PlatoNeRF takes the end, half a bin
//! late), pixels near a spot are not used (PlatoNeRF sets their histograms to zero, which then
//! count as shadow), and a pulse wider than three bins counts as one return (PlatoNeRF's bins are
//! as wide as its pulse). [`Captures::finish`] continues from there and compares each pixel's
//! two-bounce light with the expected light of a lit pixel; [`Captures::finish_plain`] does not.

use picofarm_scene::{Beam, Camera, Laser, Vec3};
use picofarm_settings::Sensor;
use picofarm_transient::Gate;
use rayon::prelude::*;

use super::{
    counted::{Counted, Detector},
    expected::{Return, expected},
};
use crate::{LeftOut, Measured, MeasuredSpot, NEAR_SPOT_SINE, ReconstructError, unlit};

/// A pixel is lit if the matched filter's response is at least this (PlatoNeRF's threshold in all
/// four of its scenes).
pub const LIT_THRESHOLD: f32 = 0.15;
/// The largest angle between a beam's spot and the brightest pixel, radians. A larger angle means
/// that a mirror reflected the beam.
const ASTRAY: f32 = 0.04;
/// Bins of the pulse template below this share of its peak are omitted.
const TEMPLATE_FLOOR: f32 = 1e-3;
/// The greatest width of a pulse at half of its peak, bins, for which a return is its brightest bin
/// and both neighbours.
const NARROW: usize = 3;
/// The share of a wider pulse's width to which a time is known.
const RESOLVED: f32 = 0.25;
/// The share of a pixel's light whose arrival counts as first light.
const EARLY: f32 = 0.03;
/// With photon noise, the number of standard deviations from which a peak counts as a return.
const CERTAIN: f32 = 3.0;

/// Processes captures one by one, so that only the histograms of one spot are in memory at a time.
#[derive(Debug)]
pub struct Captures {
    gate: Gate,
    threshold: f32,
    laser: Laser,
    detector: Option<Detector>,
    measured: Measured,
    /// The strongest return of every pixel and spot, `[spot][row][column]`.
    returns: Vec<Return>,
}

impl Captures {
    /// Starts with the camera, the laser and its beams' directions, and the gate of the histograms.
    pub fn new(camera: Camera, laser: Laser, gate: Gate, threshold: f32) -> Self {
        let measured = Measured {
            camera,
            laser: laser.origin,
            spots: Vec::new(),
            tau: Vec::new(),
            lit: Vec::new(),
            used: Vec::new(),
            bin_width_m: gate.bin_width_m as f32,
            mirror: Vec::new(),
            computed: false,
            confidence: Vec::new(),
            unlit_range_m: Vec::new(),
            left_out: Vec::new(),
        };
        Self {
            gate,
            threshold,
            laser,
            detector: None,
            measured,
            returns: Vec::new(),
        }
    }

    /// Simulates a detector in front of the captures: photon noise, ambient light, pulse and
    /// jitter. The ambient light of each pixel is estimated from its own bins and subtracted.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] for an invalid sensor, or one that sums bins: captures retain
    /// their bins.
    pub fn behind(self, sensor: &Sensor, seed: u64) -> Result<Self, ReconstructError> {
        sensor
            .check()
            .map_err(|e| ReconstructError::invalid("sensor", e.to_string()))?;
        if sensor.rebin != 1 {
            let what = format!(
                "is {}; captures keep their bins: leave it at 1",
                sensor.rebin
            );
            return Err(ReconstructError::invalid("sensor.rebin", what));
        }
        let sensor = sensor.clone();
        Ok(Self {
            detector: Some(Detector { sensor, seed }),
            ..self
        })
    }

    /// Sets the pixels that are known to see a mirror (1), `[row][column]`; they are not used.
    pub fn mirrors(&mut self, mirror: Vec<u8>) {
        self.measured.mirror = mirror;
    }

    /// Adds the capture of beam `beam`: histograms `[row][column][bin]`. Whole numbers are counts
    /// of photons: their ambient light is subtracted, and returns within their noise are undecided.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] for a histogram of another size, a NaN or infinite value, or a
    /// beam that does not exist.
    pub fn add(&mut self, beam: usize, histogram: &[f32]) -> Result<(), ReconstructError> {
        let (pixels, bins) = (self.measured.pixels(), self.gate.bins as usize);
        let field = || format!("captures[{beam}]");
        let Some(&Beam { direction, .. }) = self.laser.beams.get(beam) else {
            let what = format!(
                "there is no such beam, the laser has {}",
                self.laser.beams.len()
            );
            return Err(ReconstructError::invalid(field(), what));
        };
        if histogram.len() != pixels * bins {
            let what = format!(
                "has {} values, expected {pixels} pixels x {bins} bins",
                histogram.len()
            );
            return Err(ReconstructError::invalid(field(), what));
        }
        if let Some(at) = histogram.iter().position(|v| !v.is_finite()) {
            let what = format!("pixel {} bin {} is not finite", at / bins, at % bins);
            return Err(ReconstructError::invalid(field(), what));
        }
        let counted = match &self.detector {
            // Whole numbers are counts of photons, with their noise.
            None => histogram
                .par_iter()
                .all(|v| v.fract() == 0.0)
                .then(|| Counted::of_counts(histogram.to_vec(), bins)),
            Some(detector) => Some(detector.count(beam, histogram, &self.gate)?),
        };
        let histogram = counted.as_ref().map_or(histogram, |c| &c.light);
        match self.spot(direction, beam, histogram) {
            Ok((spot, template)) => self.pixels_of(spot, &template, histogram, counted.as_ref()),
            Err(why) => self.measured.left_out.push(LeftOut { beam, why }),
        }
        Ok(())
    }

    /// Excludes a beam for the given reason.
    pub fn leave_out(&mut self, beam: usize, why: &str) {
        let why = why.to_owned();
        self.measured.left_out.push(LeftOut { beam, why });
    }

    /// Returns the measurements, with masks from the expected light of a lit pixel.
    pub fn finish(self) -> Measured {
        let mut measured = expected(self.measured, &self.returns);
        let first: Vec<f32> = self.returns.iter().map(|r| r.first_m).collect();
        unlit::fill(&mut measured, &first);
        measured
    }

    /// Returns the measurements with PlatoNeRF's masks: lit if the matched filter's response
    /// reaches the threshold.
    pub fn finish_plain(self) -> Measured {
        self.measured
    }

    fn middle(&self, bin: usize) -> f32 {
        (self.gate.start_m + (bin as f64 + 0.5) * self.gate.bin_width_m) as f32
    }

    /// Steps 2 and 4: returns the spot from the brightest pixel's one-bounce peak, and the pulse
    /// from that pixel, or the reason why there is none.
    fn spot(
        &self,
        direction: Vec3,
        beam: usize,
        histogram: &[f32],
    ) -> Result<(MeasuredSpot, Vec<f32>), String> {
        let bins = self.gate.bins as usize;
        let peaks: Vec<(usize, f32)> = histogram.par_chunks(bins).map(peak).collect();
        let best = (0..peaks.len()).reduce(|a, b| if peaks[b].1 > peaks[a].1 { b } else { a });
        let Some(pixel) = best.filter(|&p| peaks[p].1 > 0.0) else {
            let end = self.gate.start_m + bins as f64 * self.gate.bin_width_m;
            return Err(format!(
                "its capture holds no light between {} m and {end:.2} m; widen the gate",
                self.gate.start_m
            ));
        };
        // The path laser → L → camera; L = laser + d · direction.
        let path = self.middle(peaks[pixel].0);
        let base = self.measured.camera.origin - self.laser.origin;
        let d = (path * path - base.dot(base)) / (2.0 * (path - base.dot(direction)));
        let point = self.laser.origin + direction * d;
        let seen = (point - self.measured.camera.origin).normalized();
        let astray = self.measured.ray(pixel).cross(seen).length();
        if !(d.is_finite() && d > 0.0) || astray > ASTRAY {
            return Err(
                "the brightest pixel does not lie where its beam points: the beam meets a mirror, or the camera does not see its spot".into(),
            );
        }
        let pulse = &histogram[pixel * bins..(pixel + 1) * bins];
        let sum: f32 = pulse.iter().sum();
        let template = pulse.iter().map(|v| v / sum).collect();
        let spot = MeasuredSpot {
            beam,
            direction,
            point,
            path_m: d,
            folded: false,
        };
        Ok((spot, template))
    }

    /// Steps 3 and 5 to 7 for every pixel.
    fn pixels_of(
        &mut self,
        spot: MeasuredSpot,
        template: &[f32],
        histogram: &[f32],
        counted: Option<&Counted>,
    ) {
        let bins = self.gate.bins as usize;
        let pulse = Pulse::new(template);
        if pulse.is_wide() {
            let resolved = RESOLVED * pulse.width as f32 * self.gate.bin_width_m as f32;
            self.measured.bin_width_m = self.measured.bin_width_m.max(resolved);
        }
        let to_spot = (spot.point - self.measured.camera.origin).normalized();
        // No light of this spot arrives before that of its shortest path.
        let soonest = spot.path_m + (spot.point - self.measured.camera.origin).length();
        let dark = (f64::from(soonest) - self.gate.start_m) / self.gate.bin_width_m
            - (2 * pulse.half()) as f64;
        let dark = (dark.max(0.0) as usize).min(bins);
        let this = &*self;
        let pixel = |(p, h): (usize, &[f32])| -> (f32, u8, u8, Return) {
            let near = this.measured.ray(p).cross(to_spot).length() < NEAR_SPOT_SINE;
            let mirror = this.measured.mirror.get(p).is_some_and(|&m| m != 0);
            let sum: f32 = h.iter().sum();
            if near || mirror || sum <= 0.0 {
                // A histogram without any light is not evidence: not even light of three bounces
                // arrived.
                let none = Return {
                    first_m: f32::NAN,
                    ..Return::default()
                };
                return (0.0, 0, 0, none);
            }
            let (bin, response) = pulse.response(h);
            let tau = this.middle(bin);
            let half = pulse.half();
            let around = &h[bin.saturating_sub(half)..(bin + half + 1).min(bins)];
            let near: f32 = around.iter().sum();
            // The variance of counts is their sum, ambient counts included.
            let noise = counted.map_or(0.0, |c| {
                (near.max(0.0) + c.ambient[p] * around.len() as f32).sqrt()
            });
            let certain = near >= CERTAIN * noise;
            let lit = response / sum >= this.threshold * pulse.own && tau > spot.path_m && certain;
            let strongest = Return {
                path_m: tau,
                energy: near,
                share: near / sum,
                noise,
                first_m: first_light(h, dark).map_or(f32::NAN, |bin| this.middle(bin)),
            };
            (if lit { tau } else { 0.0 }, u8::from(lit), 1, strongest)
        };
        let found: Vec<_> = histogram.par_chunks(bins).enumerate().map(pixel).collect();
        for (tau, lit, used, strongest) in found {
            self.measured.tau.push(tau);
            self.measured.lit.push(lit);
            self.measured.used.push(used);
            self.returns.push(strongest);
        }
        self.measured.spots.push(spot);
    }
}

/// The pulse of a capture.
struct Pulse<'a> {
    /// The share of each bin of the template above the floor, with its bin.
    taps: Vec<(usize, f32)>,
    /// The template from the first of these bins to the last.
    whole: &'a [f32],
    first: usize,
    /// The bin of its peak.
    peak: usize,
    /// Its width at half of the peak, bins.
    width: usize,
    /// The part of `whole` that is at least half as high as the peak.
    core: std::ops::Range<usize>,
    /// The greatest response of a histogram that is the pulse alone; 1 for a narrow one, because
    /// the threshold refers to it.
    own: f32,
}

impl<'a> Pulse<'a> {
    fn new(template: &'a [f32]) -> Self {
        let (peak, most) = peak(template);
        let floor = TEMPLATE_FLOOR.min(0.5 * most);
        let above = |&(_, v): &(usize, f32)| v >= floor;
        let taps: Vec<(usize, f32)> =
            (template.iter().copied().enumerate().filter(above)).collect();
        let first = taps.first().map_or(0, |t| t.0);
        let last = taps.last().map_or(0, |t| t.0);
        let high = |v: &&f32| **v >= 0.5 * most;
        let before = template[..peak].iter().rev().take_while(high).count();
        let width = before + template[peak..].iter().take_while(high).count();
        let core = peak - before - first..peak - before - first + width;
        let own = match width > NARROW {
            true => taps.iter().map(|(_, v)| v * v).sum(),
            false => 1.0,
        };
        Self {
            taps,
            whole: template.get(first..=last).unwrap_or(&[]),
            first,
            peak,
            width,
            core,
            own,
        }
    }

    fn is_wide(&self) -> bool {
        self.width > NARROW
    }

    /// Returns the number of bins on each side of a return's brightest one that are part of it.
    fn half(&self) -> usize {
        match self.is_wide() {
            true => self.width / 2,
            false => 1,
        }
    }

    /// Returns the bin of the strongest return and the greatest response of the matched filter. A
    /// narrow return is the highest bin. A wide one is where the core of the pulse fits best.
    fn response(&self, h: &[f32]) -> (usize, f32) {
        let bins = h.len();
        if !self.is_wide() {
            let last = self.taps.last().map_or(0, |t| t.0);
            let mut response = 0.0f32;
            for lag in -(last as i64)..(bins - self.first) as i64 {
                let at = |t: usize| usize::try_from(t as i64 + lag).ok().and_then(|b| h.get(b));
                let taps = self.taps.iter();
                let c: f32 = taps.map(|&(t, v)| v * at(t).copied().unwrap_or(0.0)).sum();
                response = response.max(c);
            }
            return (peak(h).0, response);
        }
        // The time follows from the core of the pulse, because light of three bounces arrives in
        // its tail.
        let before = self.peak - self.first;
        let (mut at, mut most, mut response) = (0, 0.0f32, 0.0f32);
        for bin in 0..bins {
            let light = &h[bin.saturating_sub(before)..];
            let whole = &self.whole[before.saturating_sub(bin)..];
            response = response.max(product(whole, light));
            let core = &self.whole[self.core.start.max(before.saturating_sub(bin))..self.core.end];
            let first = (bin + self.core.start).saturating_sub(before);
            let near = product(core, h.get(first..).unwrap_or(&[]));
            if near > most {
                (at, most) = (bin, near);
            }
        }
        (at, response)
    }
}

fn product(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Returns the bin by which a small share of a histogram's light has arrived, or `None` without
/// light. The first `dark` bins have no light but the background.
fn first_light(h: &[f32], dark: usize) -> Option<usize> {
    let (before, after) = h.split_at(dark);
    let count = before.len().max(1) as f32;
    let level = before.iter().sum::<f32>() / count;
    let variance = before
        .iter()
        .map(|v| (v - level) * (v - level))
        .sum::<f32>()
        / count;
    let all: f32 = after.iter().map(|v| v - level).sum();
    let mut sum = 0.0f32;
    let arrived = |(n, v): (usize, &f32)| {
        sum += v - level;
        sum > 0.0 && sum >= EARLY * all && sum >= CERTAIN * (variance * (n + 1) as f32).sqrt()
    };
    after.iter().enumerate().position(arrived).map(|n| n + dark)
}

/// Returns the first highest bin and its value.
fn peak(h: &[f32]) -> (usize, f32) {
    let better =
        |best: (usize, f32), (b, &v): (usize, &f32)| if v > best.1 { (b, v) } else { best };
    h.iter().enumerate().fold((0, 0.0), better)
}
