//! The pulse and the jitter as one kernel on the histogram's bins.

use std::f64::consts::{FRAC_PI_2, LN_2, SQRT_2};

use picofarm_settings::{Jitter, Pulse, Sensor, SensorError};

/// Fraction of the energy cut off at each end of a kernel: next to a peak of 4·10⁷ photons, less
/// than 0.01 photons.
const CUT: f64 = 1e-10;
/// The longest kernel, bins.
const MAX_TAPS: f64 = 8192.0;
/// The maximum number of sub-bins of a kernel.
const MAX_FINE: f64 = 262_144.0;

/// A blur: light that arrives in bin b is spread to bins b + first, b + first + 1, … in the
/// fractions `taps`.
#[derive(Debug, Clone, PartialEq)]
pub struct Kernel {
    /// Displacement of the first tap, bins; negative = earlier.
    pub first: i64,
    /// Fractions of the energy; their sum is 1.
    pub taps: Vec<f64>,
}

impl Kernel {
    /// Returns pulse ⊛ jitter for bins of `bin_width_ps`. Light is assumed to arrive at its bin's
    /// centre, and a tap is the energy that falls into a bin. (Jitter of the kind `sb3d_compat` is
    /// a shift and not part of the kernel.)
    ///
    /// # Errors
    /// Returns [`SensorError::Invalid`] if a setting or `bin_width_ps` is unusable, or the kernel
    /// would span more than 8192 bins.
    ///
    /// # Examples
    /// ```
    /// use picofarm_sensor::{Kernel, Sensor};
    ///
    /// let kernel = Kernel::new(&Sensor::default(), 100.0)?;
    /// assert!((kernel.taps.iter().sum::<f64>() - 1.0).abs() < 1e-12);
    /// # Ok::<(), picofarm_sensor::SensorError>(())
    /// ```
    pub fn new(sensor: &Sensor, bin_width_ps: f64) -> Result<Self, SensorError> {
        sensor.check()?;
        if !(1e-3..=1e9).contains(&bin_width_ps) {
            return Err(SensorError::new(
                "bin_width_ps",
                format!("expected 0.001 to 1e9 picoseconds, found {bin_width_ps}"),
            ));
        }
        let pulse = Shape::new(&sensor.pulse);
        let sigma = match sensor.jitter {
            Jitter::Gaussian { fwhm_ps } => gaussian_sigma(fwhm_ps),
            Jitter::Sb3dCompat { .. } => 0.0,
        };
        let span = (pulse.end - pulse.start + 14.0 * sigma) / bin_width_ps;
        if span > MAX_TAPS {
            return Err(SensorError::new(
                "sensor.pulse",
                format!(
                    "pulse and jitter span {span:.0} bins of {bin_width_ps:.3} ps, at most {MAX_TAPS} are possible; \
                     shorten the pulse or use wider bins"
                ),
            ));
        }
        // Sub-bins of a fiftieth of the narrower width. Their number per bin is odd, so that bins
        // and sub-bins share their centres.
        let narrow = if sigma > 0.0 {
            pulse.width.min(sigma)
        } else {
            pulse.width
        };
        let most = (MAX_FINE / (span + 2.0)).clamp(1.0, 1001.0);
        let per_bin = 2.0 * ((50.0 * bin_width_ps / narrow).clamp(1.0, most) / 2.0).floor() + 1.0;
        let step = bin_width_ps / per_bin;
        let mut fine = FineTaps::new(&pulse, step);
        if sigma > 0.0 {
            fine = fine.convolve(&FineTaps::new(&Shape::gaussian(sigma), step));
        }
        Ok(fine.binned(per_bin as i64).trimmed())
    }

    /// Returns the kernel displaced by `bins`.
    pub fn shifted(mut self, bins: i64) -> Self {
        self.first += bins;
        self
    }
}

/// Returns σ of a Gaussian with this full width at half maximum.
pub(crate) fn gaussian_sigma(fwhm: f64) -> f64 {
    fwhm / (2.0 * (2.0 * LN_2).sqrt())
}

/// A shape in time, picoseconds: its integral and its range.
struct Shape {
    integral: Box<dyn Fn(f64) -> f64>,
    start: f64,
    end: f64,
    /// The length scale of its changes.
    width: f64,
}

impl Shape {
    fn new(pulse: &Pulse) -> Self {
        match pulse {
            // All energy is at one instant, whatever the step.
            Pulse::None {} => Self {
                integral: Box::new(|t| f64::from(t >= 0.0)),
                start: 0.0,
                end: 0.0,
                width: f64::INFINITY,
            },
            Pulse::Analytic { fwhm_ps } => Self::analytic(*fwhm_ps),
            Pulse::Sampled {
                bin_width_ps,
                values,
                zero_bin,
            } => Self::sampled(*bin_width_ps, values, *zero_bin),
        }
    }

    fn gaussian(sigma: f64) -> Self {
        Self {
            integral: Box::new(move |t| 0.5 * libm::erfc(-t / (sigma * SQRT_2))),
            start: -7.0 * sigma,
            end: 7.0 * sigma,
            width: sigma,
        }
    }

    fn analytic(fwhm: f64) -> Self {
        let s = fwhm / ((2.0 * LN_2).sqrt() + 0.25 + 2.0 * LN_2);
        let (tau, meet) = (2.0 * s, 0.5 * s);
        let crest = move |t: f64| s * FRAC_PI_2.sqrt() * libm::erfc(-t / (s * SQRT_2));
        let level = libm::exp(-meet * meet / (2.0 * s * s));
        Self {
            integral: Box::new(move |t| {
                if t < meet {
                    crest(t)
                } else {
                    crest(meet) - level * tau * libm::expm1(-(t - meet) / tau)
                }
            }),
            start: -7.0 * s,
            end: meet - tau * libm::log(CUT / 4.0),
            width: s,
        }
    }

    fn sampled(width: f64, values: &[f64], zero_bin: Option<f64>) -> Self {
        let zero = zero_bin.unwrap_or_else(|| {
            let largest = values.iter().copied().fold(0.0, f64::max);
            let at = values.iter().position(|v| *v == largest);
            at.unwrap_or(0) as f64
        });
        let start = -(zero + 0.5) * width;
        let mut sums = Vec::with_capacity(values.len() + 1);
        sums.push(0.0);
        for v in values {
            sums.push(sums[sums.len() - 1] + v);
        }
        let n = values.len();
        Self {
            integral: Box::new(move |t| {
                let at = ((t - start) / width).clamp(0.0, n as f64);
                let i = (at as usize).min(n - 1);
                sums[i] + (at - i as f64) * (sums[i + 1] - sums[i])
            }),
            start,
            end: start + n as f64 * width,
            width,
        }
    }
}

/// Energy by sub-bin; sub-bin i is centred at i steps.
struct FineTaps {
    first: i64,
    energy: Vec<f64>,
}

impl FineTaps {
    fn new(shape: &Shape, step: f64) -> Self {
        let first = (shape.start / step - 0.5).floor() as i64;
        let last = (shape.end / step + 0.5).ceil() as i64;
        let edge = |i: i64| (shape.integral)((i as f64 - 0.5) * step);
        let energy = (first..=last).map(|i| edge(i + 1) - edge(i)).collect();
        Self { first, energy }
    }

    fn convolve(&self, other: &Self) -> Self {
        let mut energy = vec![0.0; self.energy.len() + other.energy.len() - 1];
        for (i, a) in self.energy.iter().enumerate() {
            for (sum, b) in energy[i..].iter_mut().zip(&other.energy) {
                *sum += a * b;
            }
        }
        Self {
            first: self.first + other.first,
            energy,
        }
    }

    /// Returns the sums of `per_bin` (odd) sub-bins.
    fn binned(&self, per_bin: i64) -> Kernel {
        let bin = |i: i64| (i + per_bin / 2).div_euclid(per_bin);
        let first = bin(self.first);
        let last = bin(self.first + self.energy.len() as i64 - 1);
        let mut taps = vec![0.0; (last - first + 1) as usize];
        for (i, e) in self.energy.iter().enumerate() {
            taps[(bin(self.first + i as i64) - first) as usize] += e;
        }
        Kernel { first, taps }
    }
}

impl Kernel {
    /// Removes the ends with negligible energy and normalises the sum to 1.
    fn trimmed(mut self) -> Self {
        let total: f64 = self.taps.iter().sum();
        let idle = |taps: &mut dyn Iterator<Item = &f64>| {
            let mut cut = 0.0;
            taps.take_while(|t| {
                cut += **t;
                cut <= CUT * total
            })
            .count()
        };
        let head = idle(&mut self.taps.iter());
        let tail = idle(&mut self.taps.iter().rev());
        self.taps.truncate(self.taps.len() - tail);
        self.taps.drain(..head);
        self.first += head as i64;
        let total: f64 = self.taps.iter().sum();
        for t in &mut self.taps {
            *t /= total;
        }
        self
    }
}
