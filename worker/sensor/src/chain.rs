//! The steps for one pixel: expected photons, pile-up, counts, sums of adjacent bins.

use picofarm_settings::{DeadTime, Sensor, SensorError};
use rayon::prelude::*;

use crate::{
    convolve::Convolver,
    draw::{PixelKey, Purpose, binomial, poisson},
    scale::Scaled,
    sense::{Dropped, Histograms},
};

/// The highest rate of a bin, photons. The count fits a u32; sums of bins must fit as well.
const MAX_RATE: f64 = 4e9;

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
}

/// Values shared by all pixels.
pub(crate) struct Chain<'a> {
    pub sensor: &'a Sensor,
    pub h: &'a Histograms<'a>,
    pub convolver: Convolver,
    pub scale: Scaled,
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
        finish: impl Fn(&Self, usize, &[f64], &mut [T]) -> Option<Fault> + Sync,
    ) -> Vec<PixelTotals> {
        out.par_chunks_mut(self.out_bins)
            .zip(self.h.transient.par_chunks(self.h.bins))
            .enumerate()
            .map_init(
                || (self.convolver.clone(), vec![0.0; self.h.bins]),
                |(convolver, rate), (pixel, (out, h))| {
                    let mut totals = self.rate(convolver, h, rate);
                    if totals.fault.is_none() {
                        totals.fault = finish(self, pixel, rate, out);
                    }
                    totals
                },
            )
            .collect()
    }

    /// Step 1: the expected photons of each bin.
    fn rate(&self, convolver: &mut Convolver, h: &[f32], rate: &mut [f64]) -> PixelTotals {
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
        let outside = scale * convolver.run(h, rate);
        let (mut light, mut brightest) = ([0.0; 4], [0.0; 4]);
        for quad in rate.chunks_mut(4) {
            for ((r, light), brightest) in quad.iter_mut().zip(&mut light).zip(&mut brightest) {
                let photons = scale * *r;
                *light += photons;
                *r = photons + self.sensor.dark_per_bin;
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
        PixelTotals {
            light: light + outside,
            outside,
            left_over: rate[self.out_bins * self.factor..].iter().sum(),
            pile_up: self.piled_up(rate),
            fault: (brightest > MAX_RATE).then(too_bright),
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
        rate: &[f64],
        out: &mut [f32],
        convert: impl Fn(f32) -> f32,
    ) -> Option<Fault> {
        let mut earlier = 0.0;
        for (out, group) in out.iter_mut().zip(rate.chunks_exact(self.factor)) {
            let sum: f64 = match self.sensor.dead_time {
                None => group.iter().sum(),
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
        rate: &[f64],
        out: &mut [T],
        convert: impl Fn(u32) -> T,
    ) -> Option<Fault> {
        let key = PixelKey::new(self.seed, Purpose::Counts, self.scene, pixel as u64);
        let mut waiting = match self.sensor.dead_time {
            Some(DeadTime::FirstPhoton { pulses }) => pulses,
            None => 0,
        };
        let per_pulse = 1.0 / waiting as f64;
        for (i, (out, group)) in out
            .iter_mut()
            .zip(rate.chunks_exact(self.factor))
            .enumerate()
        {
            let mut sum = 0;
            for (j, rate) in group.iter().enumerate() {
                let mut draws = key.bin((i * self.factor + j) as u64);
                sum += if self.sensor.dead_time.is_some() {
                    let seen = binomial(waiting, rate * per_pulse, &mut draws);
                    waiting -= seen;
                    seen
                } else {
                    poisson(*rate, &mut draws)
                };
            }
            let Ok(sum) = u32::try_from(sum) else {
                let bin = i * self.factor;
                return Some(Fault::TooBright {
                    bin,
                    rate: sum as f64,
                });
            };
            *out = convert(sum);
        }
        None
    }
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
