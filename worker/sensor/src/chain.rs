//! The steps for one pixel: expected photons, the gate, pile-up and afterpulses, counts, sums of
//! adjacent bins.

use picofarm_settings::{DeadTime, Sensor, SensorError};
use rayon::prelude::*;

use crate::{
    afterpulse::Afterpulses,
    convolve::Convolver,
    draw::{PixelKey, Purpose, binomial, poisson},
    free_running::{FreeBuffers, FreeRunning},
    image::neighbours,
    resample::Resampler,
    scale::Scaled,
    sense::{Dropped, Histograms},
};

/// The highest rate of a bin, photons. The count fits a u32; sums of bins must fit as well.
const MAX_RATE: f64 = 4e9;
/// The most detections of a pixel that are drawn one after another.
const MAX_DRAWN: f64 = 1e8;

/// One pixel's contribution to the totals.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PixelTotals {
    light: f64,
    outside: f64,
    left_over: f64,
    pile_up: f64,
    fault: Option<Fault>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum Fault {
    Value { bin: usize, value: f32 },
    TooBright { bin: usize, rate: f64 },
    TooMany { detections: f64 },
}

/// Buffers of one thread, for one pixel after another.
pub(crate) struct Scratch {
    convolver: Convolver,
    /// The light of each bin of the histogram, if the detector has a gate of its own.
    ungated: Vec<f64>,
    /// Photons that arrive in each bin of the detector.
    pub rate: Vec<f64>,
    /// Expected counts of each bin, if they differ from the photons and are not those of
    /// [`DeadTime::FirstPhoton`].
    expected: Vec<f64>,
    counts: Vec<u64>,
    free: FreeBuffers,
}

/// Values shared by all pixels.
pub(crate) struct Chain<'a> {
    pub sensor: &'a Sensor,
    pub h: &'a Histograms<'a>,
    pub convolver: Convolver,
    pub scale: Scaled,
    /// The detector's own bins.
    pub gate: Option<Resampler>,
    /// Bins of the detector.
    pub seen_bins: usize,
    /// Pixels in a row and probability, if there is crosstalk.
    pub crosstalk: Option<(usize, f64)>,
    pub free: Option<FreeRunning>,
    /// Afterpulses without a dead time.
    pub after: Option<Afterpulses>,
    /// Adjacent bins that are summed.
    pub factor: usize,
    /// Bins per pixel after rebinning.
    pub out_bins: usize,
    pub seed: u64,
    pub scene: u64,
}

impl Chain<'_> {
    pub fn run<T: Send>(
        &self,
        out: &mut [T],
        finish: impl Fn(&Self, usize, &mut Scratch, &mut [T]) -> Option<Fault> + Sync,
    ) -> Vec<PixelTotals> {
        let special = self.free.is_some() || self.after.is_some();
        let length = |needed: bool, bins: usize| if needed { bins } else { 0 };
        out.par_chunks_mut(self.out_bins)
            .zip(self.h.transient.par_chunks(self.h.bins))
            .enumerate()
            .map_init(
                || Scratch {
                    convolver: self.convolver.clone(),
                    ungated: vec![0.0; length(self.gate.is_some(), self.h.bins)],
                    rate: vec![0.0; self.seen_bins],
                    expected: vec![0.0; length(special, self.seen_bins)],
                    counts: vec![0; length(special, self.seen_bins)],
                    free: FreeBuffers::default(),
                },
                |scratch, (pixel, (out, h))| {
                    let mut totals = self.rate(pixel, h, scratch);
                    if totals.fault.is_none() {
                        totals.fault = finish(self, pixel, scratch, out);
                    }
                    totals
                },
            )
            .collect()
    }

    /// Dark counts of each bin of a pixel, with those of its neighbours that cross over.
    fn dark(&self, pixel: usize) -> f64 {
        let dark = self.sensor.dark_per_bin;
        match self.crosstalk {
            None => dark,
            Some((width, k)) => {
                let pixels = self.h.transient.len() / self.h.bins;
                let others = neighbours(pixel, pixels, width).count();
                dark * (1.0 + k * others as f64)
            }
        }
    }

    /// Steps 1 to 3: the expected photons of each bin, and the expected counts.
    fn rate(&self, pixel: usize, h: &[f32], scratch: &mut Scratch) -> PixelTotals {
        let odd = |h: &f32| !(0.0..=f32::MAX).contains(h);
        // Without an early exit, so that eight bins are tested at a time.
        if h.iter().fold(false, |any, h| any | odd(h))
            && let Some(bin) = h.iter().position(odd)
        {
            let fault = Some(Fault::Value { bin, value: h[bin] });
            return PixelTotals {
                fault,
                ..PixelTotals::default()
            };
        }
        let scale = self.scale.per_unit;
        let rate = &mut scratch.rate;
        let outside = match &self.gate {
            None => scale * scratch.convolver.run(h, rate),
            Some(gate) => {
                let gone = scratch.convolver.run(h, &mut scratch.ungated);
                rate.fill(0.0);
                scale * (gone + gate.add(&scratch.ungated, rate))
            }
        };
        let dark = self.dark(pixel);
        let (mut light, mut brightest) = ([0.0; 4], [0.0; 4]);
        for quad in rate.chunks_mut(4) {
            for ((r, light), brightest) in quad.iter_mut().zip(&mut light).zip(&mut brightest) {
                let photons = scale * *r;
                *light += photons;
                *r = photons + dark;
                *brightest = if *r > *brightest { *r } else { *brightest };
            }
        }
        let light: f64 = light.iter().sum();
        let brightest = brightest.into_iter().fold(0.0, f64::max);
        let too_bright = || {
            let bin = rate.iter().position(|r| *r == brightest).unwrap_or(0);
            Fault::TooBright {
                bin,
                rate: brightest,
            }
        };
        let mut fault = (brightest > MAX_RATE).then(too_bright);
        let mut pile_up = self.piled_up(rate);
        let expected = &mut scratch.expected;
        if let Some(free) = &self.free {
            free.expect(rate, dark, expected, &mut scratch.free);
            let (all, seen) = (rate.iter().sum::<f64>(), expected.iter().sum::<f64>());
            pile_up = (all - seen).max(0.0);
            fault = fault.or((seen > MAX_DRAWN).then_some(Fault::TooMany { detections: seen }));
        } else if let Some(after) = &self.after {
            expected.copy_from_slice(rate);
            after.expect(expected);
            let made = expected.iter().sum::<f64>() - rate.iter().sum::<f64>();
            fault = fault.or((made > MAX_DRAWN).then_some(Fault::TooMany { detections: made }));
        }
        PixelTotals {
            light: light + outside,
            outside,
            left_over: rate[self.out_bins * self.factor..].iter().sum(),
            pile_up,
            fault,
        }
    }

    /// Returns the expected photons lost to pile-up.
    fn piled_up(&self, rate: &[f64]) -> f64 {
        let Some(DeadTime::FirstPhoton { pulses }) = self.sensor.dead_time else {
            return 0.0;
        };
        let (all, n) = (rate.iter().sum::<f64>(), pulses as f64);
        all + n * libm::expm1(-all / n)
    }

    /// Writes the expected counts, rebinned and converted by `convert`.
    pub fn expect(
        &self,
        scratch: &Scratch,
        out: &mut [f32],
        convert: impl Fn(f32) -> f32,
    ) -> Option<Fault> {
        let mut earlier = 0.0;
        let counted = match scratch.expected.is_empty() {
            true => &scratch.rate,
            false => &scratch.expected,
        };
        for (out, group) in out.iter_mut().zip(counted.chunks_exact(self.factor)) {
            let sum: f64 = match self.sensor.dead_time {
                None | Some(DeadTime::FreeRunning { .. }) => group.iter().sum(),
                Some(DeadTime::FirstPhoton { pulses }) => {
                    let n = pulses as f64;
                    let arriving = group.iter().sum::<f64>() / n;
                    // The bins' probabilities telescope.
                    let seen = -n * libm::exp(-earlier) * libm::expm1(-arriving);
                    earlier += arriving;
                    seen
                }
            };
            *out = convert(sum as f32);
        }
        None
    }

    /// Writes the drawn counts, rebinned and converted by `convert`.
    pub fn count<T>(
        &self,
        pixel: usize,
        scratch: &mut Scratch,
        out: &mut [T],
        convert: impl Fn(u32) -> T,
    ) -> Option<Fault> {
        let key = |purpose| PixelKey::new(self.seed, purpose, self.scene, pixel as u64);
        if let Some(free) = &self.free {
            let mut draws = key(Purpose::FreeRunning).bin(0);
            let (dark, own) = (self.dark(pixel), &mut scratch.free);
            free.draw(&scratch.rate, dark, &mut draws, &mut scratch.counts, own);
            return self.sums(&scratch.counts, out, convert);
        }
        let key_of_counts = key(Purpose::Counts);
        if let Some(after) = &self.after {
            for (bin, (count, rate)) in scratch.counts.iter_mut().zip(&scratch.rate).enumerate() {
                *count = poisson(*rate, &mut key_of_counts.bin(bin as u64));
            }
            after.draw(key(Purpose::Afterpulses), &mut scratch.counts);
            return self.sums(&scratch.counts, out, convert);
        }
        let mut waiting = match self.sensor.dead_time {
            Some(DeadTime::FirstPhoton { pulses }) => pulses,
            None | Some(DeadTime::FreeRunning { .. }) => 0,
        };
        let per_pulse = 1.0 / waiting as f64;
        for (i, (out, group)) in out
            .iter_mut()
            .zip(scratch.rate.chunks_exact(self.factor))
            .enumerate()
        {
            let mut sum = 0;
            for (j, rate) in group.iter().enumerate() {
                let mut draws = key_of_counts.bin((i * self.factor + j) as u64);
                sum += if self.sensor.dead_time.is_some() {
                    let seen = binomial(waiting, rate * per_pulse, &mut draws);
                    waiting -= seen;
                    seen
                } else {
                    poisson(*rate, &mut draws)
                };
            }
            if let Some(fault) = store(sum, i * self.factor, out, &convert) {
                return Some(fault);
            }
        }
        None
    }

    /// Writes sums of adjacent counts.
    fn sums<T>(&self, counts: &[u64], out: &mut [T], convert: impl Fn(u32) -> T) -> Option<Fault> {
        let groups = out.iter_mut().zip(counts.chunks_exact(self.factor));
        groups
            .enumerate()
            .find_map(|(i, (out, group))| store(group.iter().sum(), i * self.factor, out, &convert))
    }
}

/// Writes a count, unless it is too large.
fn store<T>(sum: u64, bin: usize, out: &mut T, convert: impl Fn(u32) -> T) -> Option<Fault> {
    let Ok(count) = u32::try_from(sum) else {
        let rate = sum as f64;
        return Some(Fault::TooBright { bin, rate });
    };
    *out = convert(count);
    None
}

/// Sums in the order of the pixels. The first fault is the error.
pub(crate) fn total(totals: &[PixelTotals], left_over_bins: usize) -> Result<Dropped, SensorError> {
    let mut dropped = Dropped {
        bins: left_over_bins,
        ..Dropped::default()
    };
    let mut light = 0.0;
    for (pixel, f) in totals.iter().enumerate() {
        match f.fault {
            None => {}
            Some(Fault::Value { bin, value }) => {
                return Err(SensorError::new(
                    format!("transient[pixel {pixel}][bin {bin}]"),
                    format!("expected a finite value of at least 0, found {value}"),
                ));
            }
            Some(Fault::TooBright { bin, rate }) => {
                return Err(SensorError::new(
                    format!("transient[pixel {pixel}][bin {bin}]"),
                    format!(
                        "{rate:.3e} photons are more than a bin holds ({MAX_RATE:.0e}, and 4.3e9 after rebinning); \
                         choose a smaller sensor.scale"
                    ),
                ));
            }
            Some(Fault::TooMany { detections }) => {
                return Err(SensorError::new(
                    format!("transient[pixel {pixel}]"),
                    format!(
                        "{detections:.3e} detections or afterpulses are more than are drawn one by one ({MAX_DRAWN:.0e}); \
                         choose a smaller sensor.scale, or fewer pulses"
                    ),
                ));
            }
        }
        light += f.light;
        dropped.outside_photons += f.outside;
        dropped.bins_photons += f.left_over;
        dropped.pile_up_photons += f.pile_up;
    }
    if light > 0.0 {
        dropped.outside_share = dropped.outside_photons / light;
    }
    Ok(dropped)
}
