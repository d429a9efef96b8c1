//! The whole chain from transients to counts.

use picofarm_settings::{DeadTime, Jitter, Scale, Sensor, SensorError};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    bins::{check_factor, pixels},
    convolve::Convolver,
    draw::{PixelKey, Purpose, binomial, poisson},
    kernel::Kernel,
};

/// The highest rate of a bin, photons. The count fits a u32; sums of bins must fit as well.
const MAX_RATE: f64 = 4e9;

/// The input of a sensor.
#[derive(Debug, Clone, Copy)]
pub struct Histograms<'a> {
    /// h, all bounces, `[pixel][bin]`; finite and at least 0.
    pub transient: &'a [f32],
    /// The exactly-two-bounce part of the transient, in the same shape, which sets the scale. If
    /// `None`, the whole transient sets the scale (in most pixels the brightest bin is the
    /// two-bounce peak all the same).
    pub two_bounce: Option<&'a [f32]>,
    /// Bins per pixel.
    pub bins: usize,
    /// Width of a bin, picoseconds: [`super::PS_PER_M`] times metres of path.
    pub bin_width_ps: f64,
}

/// The sensor's image.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// Counted photons, `[pixel][bin]`.
    Counts(Vec<u32>),
    /// Expected photons, `[pixel][bin]`, if noise is turned off.
    Rate(Vec<f32>),
}

impl Values {
    /// Returns the sum of all values.
    pub fn sum(&self) -> f64 {
        match self {
            Self::Rate(rate) => rate.iter().map(|r| f64::from(*r)).sum(),
            Self::Counts(counts) => counts.iter().map(|c| u64::from(*c)).sum::<u64>() as f64,
        }
    }
}

/// Returns the counts in 16 bits, or `None` if one is too large.
pub fn narrow(counts: &[u32]) -> Option<Vec<u16>> {
    counts.iter().map(|c| u16::try_from(*c).ok()).collect()
}

/// The result of a measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensed {
    /// The image.
    pub values: Values,
    /// Bins per pixel after rebinning.
    pub bins: usize,
    /// Width of a bin after rebinning, picoseconds.
    pub bin_width_ps: f64,
    /// Photons per unit of h.
    pub scale: f64,
    /// The peak that set the scale, photons; `None` for a fixed scale and for scenes without light.
    pub peak_photons: Option<f64>,
    /// Bins by which the pulse was shifted (`sb3d_compat` jitter; otherwise 0).
    pub shift_bins: i64,
    /// Expected photons missing from the image.
    pub dropped: Dropped,
}

/// Expected photons missing from the image, of all pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Dropped {
    /// Photons moved out of the gate by pulse and jitter.
    pub outside_photons: f64,
    /// These photons as a fraction of all light, excluding dark counts.
    pub outside_share: f64,
    /// Bins per pixel left over by rebinning.
    pub bins: usize,
    /// Photons in these bins, including dark counts.
    pub bins_photons: f64,
    /// Photons lost to pile-up.
    pub pile_up_photons: f64,
}

/// One pixel's contribution to the totals.
#[derive(Debug, Clone, Copy, Default)]
struct Facts {
    light: f64,
    outside: f64,
    left_over: f64,
    pile_up: f64,
    fault: Option<Fault>,
}

#[derive(Debug, Clone, Copy)]
enum Fault {
    Value { bin: usize, value: f32 },
    TooBright { bin: usize, rate: f64 },
}

/// Measures scene `scene`. All random numbers depend only on (`seed`, `scene`, pixel, bin). Uses
/// rayon's current pool.
///
/// # Errors
/// Returns [`SensorError::Invalid`] for an unusable setting, shapes that do not agree, a negative
/// or non-finite value of h, a transient with light but no peak to scale by, or a bin of more than
/// 10⁹ photons (2³² after rebinning).
pub fn sense(
    sensor: &Sensor,
    h: &Histograms<'_>,
    seed: u64,
    scene: u64,
) -> Result<Sensed, SensorError> {
    let sensing = Sensing::new(sensor.clone(), h.bins, h.bin_width_ps)?;
    let chain = sensing.chain(h, None, seed, scene)?;
    let len = h.transient.len() / h.bins * chain.out_bins;
    let (values, facts) = if sensor.poisson {
        let mut counts = vec![0u32; len];
        let facts = chain.run(&mut counts, |chain, pixel, rate, out| {
            chain.count(pixel, rate, out, |count| count)
        });
        (Values::Counts(counts), facts)
    } else {
        let mut rate = vec![0f32; len];
        let facts = chain.run(&mut rate, |chain, _, rate, out| {
            chain.expect(rate, out, |rate| rate)
        });
        (Values::Rate(rate), facts)
    };
    Ok(Sensed {
        values,
        bins: chain.out_bins,
        bin_width_ps: h.bin_width_ps * f64::from(sensor.rebin),
        scale: chain.scale.per_unit,
        peak_photons: chain.scale.photons,
        shift_bins: shift(sensor, seed, scene),
        dropped: total(&facts, h.bins % chain.factor)?,
    })
}

/// A sensor for many histograms with the same bins. Shared values are computed once.
#[derive(Debug, Clone)]
pub struct Sensing {
    sensor: Sensor,
    kernel: Kernel,
    bins: usize,
    bin_width_ps: f64,
}

impl Sensing {
    /// Returns a sensor for histograms of `bins` bins that are `bin_width_ps` picoseconds wide.
    ///
    /// # Errors
    /// Returns the errors of [`Kernel::new`], or [`SensorError::Invalid`] if the bins cannot be
    /// summed by the sensor's factor.
    pub fn new(sensor: Sensor, bins: usize, bin_width_ps: f64) -> Result<Self, SensorError> {
        let kernel = Kernel::new(&sensor, bin_width_ps)?;
        pixels(0, bins)?;
        check_factor(bins, sensor.rebin as usize)?;
        Ok(Self {
            sensor,
            kernel,
            bins,
            bin_width_ps,
        })
    }

    /// Measures like [`sense`], in units of h: writes photons divided by the scale into `out`,
    /// which is resized and overwritten.
    ///
    /// `peak` is the result of an earlier call for the same histograms, with any seed. It saves a
    /// pass over all histograms and gives the same bits. Returns the brightest bin of the median
    /// pixel, in units of h, if the scale follows from it and it is the same in every draw.
    ///
    /// # Errors
    /// Returns the errors of [`sense`].
    pub fn radiance(
        &self,
        transient: &[f32],
        (seed, scene): (u64, u64),
        peak: Option<f64>,
        out: &mut Vec<f32>,
    ) -> Result<Option<f64>, SensorError> {
        let h = Histograms {
            transient,
            two_bounce: None,
            bins: self.bins,
            bin_width_ps: self.bin_width_ps,
        };
        let chain = self.chain(&h, peak, seed, scene)?;
        out.resize(transient.len() / self.bins * chain.out_bins, 0.0);
        let scale = chain.scale.per_unit as f32;
        let facts = if self.sensor.poisson {
            chain.run(out, |chain, pixel, rate, out| {
                chain.count(pixel, rate, out, |count| count as f32 / scale)
            })
        } else {
            chain.run(out, |chain, _, rate, out| {
                chain.expect(rate, out, |rate| rate / scale)
            })
        };
        total(&facts, self.bins % chain.factor)?;
        let same = matches!(self.sensor.jitter, Jitter::Gaussian { .. });
        Ok(chain.scale.peak.filter(|_| same))
    }

    fn chain<'a>(
        &'a self,
        h: &'a Histograms<'a>,
        peak: Option<f64>,
        seed: u64,
        scene: u64,
    ) -> Result<Chain<'a>, SensorError> {
        check(h)?;
        let sensor = &self.sensor;
        let kernel = self.kernel.clone().shifted(shift(sensor, seed, scene));
        let convolver = Convolver::new(&kernel, h.bins);
        let scale = scale_of(sensor, h, (&convolver, peak), seed, scene)?;
        Ok(Chain {
            sensor,
            h,
            convolver,
            scale,
            factor: sensor.rebin as usize,
            out_bins: h.bins / sensor.rebin as usize,
            seed,
            scene,
        })
    }
}

fn shift(sensor: &Sensor, seed: u64, scene: u64) -> i64 {
    match sensor.jitter {
        Jitter::Gaussian { .. } => 0,
        Jitter::Sb3dCompat { sigma_bins } => {
            let mut draws = PixelKey::new(seed, Purpose::Roll, scene, 0).bin(0);
            (sigma_bins * draws.normal()).floor() as i64
        }
    }
}

/// Photons per unit of h, and the peak that determines it.
#[derive(Debug, Clone, Copy)]
struct Scaled {
    per_unit: f64,
    /// Photons of the peak, and the peak in units of h.
    photons: Option<f64>,
    peak: Option<f64>,
}

fn scale_of(
    sensor: &Sensor,
    h: &Histograms<'_>,
    (convolver, known): (&Convolver, Option<f64>),
    seed: u64,
    scene: u64,
) -> Result<Scaled, SensorError> {
    let alone = |per_unit| Scaled {
        per_unit,
        photons: None,
        peak: None,
    };
    let photons = match sensor.scale {
        Scale::Fixed { photons_per_unit } => return Ok(alone(photons_per_unit)),
        Scale::Peak { photons } => photons,
        Scale::PeakRange { low, high } => {
            let u = PixelKey::new(seed, Purpose::Peak, scene, 0)
                .bin(0)
                .uniform();
            low + (high - low) * u
        }
    };
    let part = h.two_bounce.unwrap_or(h.transient);
    match known.or_else(|| median_peak(part, h.bins, convolver)) {
        Some(peak) => Ok(Scaled {
            per_unit: photons / peak,
            photons: Some(photons),
            peak: Some(peak),
        }),
        // There is no light, so any scale gives the same image.
        None if h.transient.iter().all(|h| *h == 0.0) => Ok(alone(1.0)),
        None => Err(SensorError::new(
            "sensor.scale",
            "the two-bounce part has no light although the transient has; \
             use a fixed scale (photons_per_unit) for this scene",
        )),
    }
}

/// Returns the median over the pixels with light of the brightest bin, or `None` if no pixel has
/// any.
fn median_peak(h: &[f32], bins: usize, convolver: &Convolver) -> Option<f64> {
    let mut peaks: Vec<f64> = h
        .par_chunks(bins)
        .map_init(
            || (convolver.clone(), vec![0.0; bins]),
            |(convolver, rate), h| {
                convolver.run(h, rate);
                rate.iter().copied().fold(0.0, f64::max)
            },
        )
        .filter(|peak| *peak > 0.0)
        .collect();
    let middle = peaks.len().checked_sub(1)? / 2;
    Some(*peaks.select_nth_unstable_by(middle, f64::total_cmp).1)
}

fn check(h: &Histograms<'_>) -> Result<(), SensorError> {
    pixels(h.transient.len(), h.bins)?;
    match h.two_bounce {
        Some(two) if two.len() != h.transient.len() => Err(SensorError::new(
            "two_bounce",
            format!(
                "expected {} values as in the transient, found {}",
                h.transient.len(),
                two.len()
            ),
        )),
        _ => Ok(()),
    }
}

/// Values shared by all pixels.
struct Chain<'a> {
    sensor: &'a Sensor,
    h: &'a Histograms<'a>,
    convolver: Convolver,
    scale: Scaled,
    factor: usize,
    out_bins: usize,
    seed: u64,
    scene: u64,
}

impl Chain<'_> {
    fn run<T: Send>(
        &self,
        out: &mut [T],
        finish: impl Fn(&Self, usize, &[f64], &mut [T]) -> Option<Fault> + Sync,
    ) -> Vec<Facts> {
        out.par_chunks_mut(self.out_bins)
            .zip(self.h.transient.par_chunks(self.h.bins))
            .enumerate()
            .map_init(
                || (self.convolver.clone(), vec![0.0; self.h.bins]),
                |(convolver, rate), (pixel, (out, h))| {
                    let mut facts = self.rate(convolver, h, rate);
                    if facts.fault.is_none() {
                        facts.fault = finish(self, pixel, rate, out);
                    }
                    facts
                },
            )
            .collect()
    }

    /// Step 1: the expected photons of each bin.
    fn rate(&self, convolver: &mut Convolver, h: &[f32], rate: &mut [f64]) -> Facts {
        let odd = |h: &f32| !(0.0..=f32::MAX).contains(h);
        // Without an early exit, so that eight bins are tested at a time.
        if h.iter().fold(false, |any, h| any | odd(h))
            && let Some(bin) = h.iter().position(odd)
        {
            let fault = Some(Fault::Value { bin, value: h[bin] });
            return Facts {
                fault,
                ..Facts::default()
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
        Facts {
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

    /// Writes the expected counts, rebinned and converted by `of`.
    fn expect(&self, rate: &[f64], out: &mut [f32], of: impl Fn(f32) -> f32) -> Option<Fault> {
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
            *out = of(sum as f32);
        }
        None
    }

    /// Writes the drawn counts, rebinned and converted by `of`.
    fn count<T>(
        &self,
        pixel: usize,
        rate: &[f64],
        out: &mut [T],
        of: impl Fn(u32) -> T,
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
            *out = of(sum);
        }
        None
    }
}

/// Sums in the order of the pixels. The first fault is the error.
fn total(facts: &[Facts], left_over_bins: usize) -> Result<Dropped, SensorError> {
    let mut dropped = Dropped {
        bins: left_over_bins,
        ..Dropped::default()
    };
    let mut light = 0.0;
    for (pixel, f) in facts.iter().enumerate() {
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
