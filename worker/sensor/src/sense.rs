//! The entry points of the sensor, their input and their output.

use picofarm_settings::{Jitter, Sensor, SensorError};
use serde::{Deserialize, Serialize};

use crate::{
    afterpulse::Afterpulses,
    bins::{check_factor, pixels},
    chain::{Chain, total},
    convolve::Convolver,
    draw::{PixelKey, Purpose},
    free_running::FreeRunning,
    image::{self, Frame},
    kernel::Kernel,
    resample::Resampler,
    scale::scale_of,
};

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
    /// Width of a bin, picoseconds: [`crate::PS_PER_M`] times metres of path.
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

/// Measures scene `scene`. All random numbers depend only on (`seed`, `scene`, pixel, bin). Uses
/// rayon's current pool.
///
/// # Errors
/// Returns [`SensorError::Invalid`] for an unusable setting, shapes that do not agree, a negative
/// or non-finite value of h, a transient with light but no peak to scale by, or a bin of more than
/// 4·10⁹ photons (2³² after rebinning).
///
/// # Examples
/// ```
/// use picofarm_sensor::{Histograms, Scale, Sensor, sense};
///
/// // Four pixels of eight bins; each has its light in bin 3.
/// let mut transient = vec![0.0; 4 * 8];
/// for pixel in transient.chunks_mut(8) {
///     pixel[3] = 1.0;
/// }
/// let histograms = Histograms {
///     transient: &transient,
///     two_bounce: None,
///     bins: 8,
///     bin_width_ps: 1000.0,
/// };
/// let sensor = Sensor {
///     scale: Scale::Fixed { photons_per_unit: 500.0 },
///     ..Sensor::default()
/// };
/// let sensed = sense(&sensor, &histograms, 7, 0)?;
/// assert_eq!(sensed.values, sense(&sensor, &histograms, 7, 0)?.values);
/// assert!((1700.0..2300.0).contains(&sensed.values.sum()));
/// # Ok::<(), picofarm_sensor::SensorError>(())
/// ```
pub fn sense(
    sensor: &Sensor,
    h: &Histograms<'_>,
    seed: u64,
    scene: u64,
) -> Result<Sensed, SensorError> {
    let sensing = Sensing::new(sensor.clone(), h.bins, h.bin_width_ps)?;
    let chain = sensing.chain(h, None, seed, scene)?;
    finish(sensor, h, &chain, seed, scene)
}

/// Measures an image like [`sense`], with everything that needs rows, columns and a time axis:
/// zones, the detector's gate, and crosstalk. Values are `[row][column][bin]` of the zones.
///
/// # Errors
/// Returns the errors of [`sense`], and [`SensorError::Invalid`] if `frame` has no whole rows or
/// the zones do not divide the image.
///
/// # Examples
/// ```
/// use picofarm_sensor::{Frame, Histograms, Sensor, Zones, sense_image};
///
/// let transient = [1.0f32; 4 * 4 * 8];
/// let histograms = Histograms {
///     transient: &transient,
///     two_bounce: None,
///     bins: 8,
///     bin_width_ps: 1000.0,
/// };
/// let frame = Frame { width: 4, start_ps: 0.0 };
/// let sensor = Sensor {
///     zones: Some(Zones { rows: 2, columns: 2 }),
///     ..Sensor::default()
/// };
/// let sensed = sense_image(&sensor, &histograms, &frame, 7, 0)?;
/// assert_eq!(sensed.bins, 8);
/// # Ok::<(), picofarm_sensor::SensorError>(())
/// ```
pub fn sense_image(
    sensor: &Sensor,
    h: &Histograms<'_>,
    frame: &Frame,
    seed: u64,
    scene: u64,
) -> Result<Sensed, SensorError> {
    sensor.check()?;
    check(h)?;
    let gate = image::gate(sensor, frame, h.bins, h.bin_width_ps)?;
    let received = image::received(sensor, h, frame)?;
    let h = Histograms {
        transient: &received.transient,
        two_bounce: received.two_bounce.as_deref(),
        ..*h
    };
    let sensing = Sensing::gated(sensor.clone(), h.bins, h.bin_width_ps, gate)?;
    let Some(crosstalk) = sensor.crosstalk else {
        let chain = sensing.chain(&h, None, seed, scene)?;
        return finish(sensor, &h, &chain, seed, scene);
    };
    // The scale is that of the pixels' own light.
    let mixed = image::with_crosstalk(h.transient, h.bins, received.width, crosstalk);
    let mixed = Histograms {
        transient: &mixed,
        ..h
    };
    let mut chain = sensing.chain(&h, None, seed, scene)?;
    chain.h = &mixed;
    chain.crosstalk = Some((received.width, crosstalk.probability));
    finish(sensor, &mixed, &chain, seed, scene)
}

fn finish(
    sensor: &Sensor,
    h: &Histograms<'_>,
    chain: &Chain<'_>,
    seed: u64,
    scene: u64,
) -> Result<Sensed, SensorError> {
    let len = h.transient.len() / h.bins * chain.out_bins;
    let (values, totals) = if sensor.poisson {
        let mut counts = vec![0u32; len];
        let totals = chain.run(&mut counts, |chain, pixel, scratch, out| {
            chain.count(pixel, scratch, out, |count| count)
        });
        (Values::Counts(counts), totals)
    } else {
        let mut rate = vec![0f32; len];
        let totals = chain.run(&mut rate, |chain, _, scratch, out| {
            chain.expect(scratch, out, |rate| rate)
        });
        (Values::Rate(rate), totals)
    };
    let width_ps = sensor.gate.map_or(h.bin_width_ps, |gate| gate.bin_width_ps);
    Ok(Sensed {
        values,
        bins: chain.out_bins,
        bin_width_ps: width_ps * f64::from(sensor.rebin),
        scale: chain.scale.per_unit,
        peak_photons: chain.scale.photons,
        shift_bins: shift(sensor, seed, scene),
        dropped: total(&totals, chain.seen_bins % chain.factor)?,
    })
}

/// A sensor for many histograms with the same bins. Shared values are computed once.
#[derive(Debug, Clone)]
pub struct Sensing {
    sensor: Sensor,
    kernel: Kernel,
    bins: usize,
    bin_width_ps: f64,
    gate: Option<Resampler>,
    free: Option<FreeRunning>,
    after: Option<Afterpulses>,
}

impl Sensing {
    /// Returns a sensor for histograms of `bins` bins that are `bin_width_ps` picoseconds wide.
    ///
    /// # Errors
    /// Returns the errors of [`Kernel::new`], or [`SensorError::Invalid`] if the bins cannot be
    /// summed by the sensor's factor, or if the sensor needs an image ([`sense_image`]).
    pub fn new(sensor: Sensor, bins: usize, bin_width_ps: f64) -> Result<Self, SensorError> {
        if let Some(field) = sensor.needs_image() {
            return Err(SensorError::new(
                format!("sensor.{field}"),
                "needs an image with a time axis, and here histograms keep their pixels and bins; \
                 leave it out, or apply it with `picofarm scene sense` or a stage of kind \"reprocess\"",
            ));
        }
        Self::gated(sensor, bins, bin_width_ps, None)
    }

    fn gated(
        sensor: Sensor,
        bins: usize,
        bin_width_ps: f64,
        gate: Option<Resampler>,
    ) -> Result<Self, SensorError> {
        let kernel = Kernel::new(&sensor, bin_width_ps)?;
        pixels(0, bins)?;
        let seen = gate.as_ref().map_or(bins, Resampler::bins);
        check_factor(seen, sensor.rebin as usize)?;
        let width_ps = sensor.gate.map_or(bin_width_ps, |gate| gate.bin_width_ps);
        let free = FreeRunning::new(&sensor, seen, width_ps)?;
        let after = match free {
            Some(_) => None,
            None => Afterpulses::new(&sensor, width_ps),
        };
        Ok(Self {
            sensor,
            kernel,
            bins,
            bin_width_ps,
            gate,
            free,
            after,
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
        let totals = if self.sensor.poisson {
            chain.run(out, |chain, pixel, scratch, out| {
                chain.count(pixel, scratch, out, |count| count as f32 / scale)
            })
        } else {
            chain.run(out, |chain, _, scratch, out| {
                chain.expect(scratch, out, |rate| rate / scale)
            })
        };
        total(&totals, self.bins % chain.factor)?;
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
        let gate = self.gate.as_ref();
        let scale = scale_of(sensor, h, (&convolver, gate, peak), seed, scene)?;
        let seen_bins = gate.map_or(h.bins, Resampler::bins);
        Ok(Chain {
            sensor,
            h,
            convolver,
            scale,
            gate: self.gate.clone(),
            seen_bins,
            crosstalk: None,
            free: self.free,
            after: self.after,
            factor: sensor.rebin as usize,
            out_bins: seen_bins / sensor.rebin as usize,
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
