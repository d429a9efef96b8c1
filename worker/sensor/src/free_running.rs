//! A free-running pixel with a non-paralysable dead time: expected and drawn counts.
//!
//! Times are in bins of the gate. The rate within a bin is constant. Pulses repeat after a period;
//! the gate is at its start, and the rest of it has dark counts only.

use picofarm_settings::{Afterpulsing, DeadTime, Sensor, SensorError};

use crate::draw::Draws;

/// Most pulses whose expected counts are computed one by one. Later ones are like the last.
const MOST_PULSES: u64 = 256;
/// Pulses whose mean stands for the later ones if the counts have not settled.
const LAST: u64 = 192;
/// The longest period, bins.
const MOST_BINS: f64 = 1e5;
/// A bin is divided so that a part has at most this many photons per pulse, but in at most
/// [`MOST_PARTS`].
const PART: f64 = 0.1;
const MOST_PARTS: usize = 16;
/// Counts have settled if no bin changes by more than this from pulse to pulse.
const SETTLED: f64 = 1e-10;

/// A pixel's timing.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FreeRunning {
    pub pulses: u64,
    /// Dead time, bins.
    dead: f64,
    /// Period, bins.
    period: f64,
    /// Probability and time constant (in bins) of afterpulses.
    after: Option<(f64, f64)>,
}

/// Buffers for one pixel after another.
#[derive(Debug, Clone, Default)]
pub(crate) struct FreeBuffers {
    /// Rate of each cell, photons per pulse.
    cells: Vec<f64>,
    /// Detections until the start of each cell: of the previous period, of this one.
    before: Vec<f64>,
    now: Vec<f64>,
    found: Vec<f64>,
    late: Vec<f64>,
    /// Photons until the start of each bin.
    sums: Vec<f64>,
    pending: Vec<(u64, f64)>,
}

impl FreeRunning {
    /// Returns the timing on `bins` bins of `width_ps`; `None` for other kinds of dead time.
    pub fn new(sensor: &Sensor, bins: usize, width_ps: f64) -> Result<Option<Self>, SensorError> {
        let Some(DeadTime::FreeRunning {
            pulses,
            dead_ps,
            period_ps,
        }) = sensor.dead_time
        else {
            return Ok(None);
        };
        let (dead, period) = (dead_ps / width_ps, period_ps / width_ps);
        // Edges within a millionth of a bin are the same.
        if dead < 1.0 - 1e-6 {
            return Err(SensorError::new(
                "sensor.dead_time.dead_ps",
                format!(
                    "{dead_ps} ps are less than a bin of {width_ps:.1} ps; use narrower bins (sensor.gate), or none"
                ),
            ));
        }
        if period < bins as f64 - 1e-6 {
            return Err(SensorError::new(
                "sensor.dead_time.period_ps",
                format!(
                    "{period_ps} ps are less than the gate of {bins} bins of {width_ps:.1} ps; \
                     expected at least {:.0}",
                    bins as f64 * width_ps
                ),
            ));
        }
        if period > MOST_BINS {
            return Err(SensorError::new(
                "sensor.dead_time.period_ps",
                format!(
                    "{period_ps} ps are {period:.0} bins of {width_ps:.1} ps, at most {MOST_BINS} are possible; \
                     use wider bins (sensor.gate)"
                ),
            ));
        }
        let after = |a: Afterpulsing| (a.probability, a.decay_ps / width_ps);
        Ok(Some(Self {
            pulses,
            dead: dead.max(1.0),
            period: period.max(bins as f64),
            after: sensor.afterpulsing.map(after),
        }))
    }

    /// Writes the expected detections of all pulses in each bin to `found`. `rate` has the photons
    /// of all pulses, `dark` those of a bin outside the gate.
    ///
    /// The share of pulses in which the pixel is live at time t is L(t) = 1 − ∫ of the detections
    /// over [t − d, t], and detections are λ(t)·L(t). Within a part of a bin, the end of dead times
    /// is spread evenly, which gives L in closed form. Afterpulses add to λ(t), as if independent
    /// of L: exact to first order in their probability.
    pub fn expect(&self, rate: &[f64], dark: f64, found: &mut [f64], own: &mut FreeBuffers) {
        let n = self.pulses as f64;
        let most = rate.iter().copied().fold(dark, f64::max) / n;
        let parts = (libm::ceil(most / PART) as usize).clamp(1, MOST_PARTS);
        let (step, inside) = (1.0 / parts as f64, rate.len() * parts);
        let whole = (libm::ceil(self.period * parts as f64 - 1e-9) as usize).max(inside);
        let width = |cell: usize| (self.period - cell as f64 * step).clamp(1e-9, step);
        own.cells.clear();
        own.cells
            .extend((0..whole).map(|cell| match rate.get(cell / parts) {
                Some(rate) => rate / n * step,
                None => dark / n * width(cell),
            }));
        for edges in [&mut own.before, &mut own.now] {
            edges.clear();
            edges.resize(whole + 1, 0.0);
        }
        for sums in [&mut own.found, &mut own.late] {
            sums.clear();
            sums.resize(inside, 0.0);
        }
        found.fill(0.0);
        let (mut live, mut waiting) = (1.0f64, 0.0f64);
        let most = self.pulses.min(MOST_PULSES);
        for pulse in 0..most {
            let mut change = 0.0f64;
            for cell in 0..whole {
                let w = width(cell);
                let start = cell as f64 * step - self.dead;
                let revived = self.until(start + w, step, own) - self.until(start, step, own);
                let revived = revived.max(0.0);
                let mut arriving = own.cells[cell];
                if let Some((p, decay)) = self.after {
                    let x = w / decay;
                    let gone = -libm::expm1(-x);
                    arriving += waiting * gone + p * revived * (1.0 - gone / x);
                    waiting = waiting * (1.0 - gone) + p * revived * gone / x;
                }
                let kept = libm::exp(-arriving);
                let share = match arriving > 1e-9 {
                    true => -libm::expm1(-arriving) / arriving,
                    false => 1.0 - 0.5 * arriving,
                };
                let next = (live * kept + revived * share).clamp(0.0, 1.0);
                let seen = (live - next + revived).max(0.0);
                live = next;
                own.now[cell + 1] = own.now[cell] + seen;
                if cell < inside {
                    found[cell / parts] += seen;
                    change = change.max((seen - own.found[cell]).abs());
                    own.found[cell] = seen;
                    if most - pulse <= LAST {
                        own.late[cell] += seen;
                    }
                }
            }
            std::mem::swap(&mut own.before, &mut own.now);
            let later = (self.pulses - pulse - 1) as f64;
            if change < SETTLED && pulse > 0 {
                for (cell, seen) in own.found.iter().enumerate() {
                    found[cell / parts] += later * seen;
                }
                return;
            }
            if pulse + 1 == most && later > 0.0 {
                for (cell, late) in own.late.iter().enumerate() {
                    found[cell / parts] += later * late / LAST as f64;
                }
            }
        }
    }

    /// Detections until a time of this period; until now if it is negative, of the previous one.
    fn until(&self, time: f64, step: f64, own: &FreeBuffers) -> f64 {
        let last = own.before.len() - 1;
        let (edges, at, base) = match time < 0.0 {
            true => (&own.before, time + self.period, own.before[last]),
            false => (&own.now, time, 0.0),
        };
        let cell = ((at / step) as usize).min(last - 1);
        let width = (self.period - cell as f64 * step).clamp(1e-9, step);
        let part = ((at - cell as f64 * step) / width).clamp(0.0, 1.0);
        edges[cell] + part * (edges[cell + 1] - edges[cell]) - base
    }

    /// Draws the detections of all pulses, one after another, into `counts`. The cost is that of
    /// the detections, not of the pulses.
    pub fn draw(
        &self,
        rate: &[f64],
        dark: f64,
        draws: &mut Draws,
        counts: &mut [u64],
        own: &mut FreeBuffers,
    ) {
        counts.fill(0);
        let n = self.pulses as f64;
        own.sums.clear();
        own.sums.push(0.0);
        for r in rate {
            own.sums.push(own.sums[own.sums.len() - 1] + r / n);
        }
        let bins = rate.len();
        let inside = own.sums[bins];
        let dark = dark / n;
        let all = inside + dark * (self.period - bins as f64);
        if all <= 0.0 {
            return;
        }
        own.pending.clear();
        let (mut pulse, mut time) = (0u64, 0.0f64);
        while pulse < self.pulses {
            // Photons until now in this period, and until the next one.
            let passed = match time < bins as f64 {
                true => {
                    let bin = time as usize;
                    own.sums[bin] + (time - bin as f64) * (own.sums[bin + 1] - own.sums[bin])
                }
                false => inside + dark * (time - bins as f64),
            };
            let target = passed - libm::log(1.0 - draws.uniform());
            let periods = libm::floor(target / all);
            if periods >= (self.pulses - pulse) as f64 && own.pending.is_empty() {
                return;
            }
            let rest = (target - periods * all).clamp(0.0, all);
            let at = match rest < inside {
                true => {
                    let bin = own.sums.partition_point(|s| *s <= rest).clamp(1, bins) - 1;
                    let here = own.sums[bin + 1] - own.sums[bin];
                    let part = if here > 0.0 {
                        (rest - own.sums[bin]) / here
                    } else {
                        0.0
                    };
                    bin as f64 + part.clamp(0.0, 1.0)
                }
                false if dark > 0.0 => bins as f64 + (rest - inside) / dark,
                false => bins as f64,
            };
            // Time does not run backwards where rounding moves it across an edge.
            let photon = (pulse.saturating_add(periods as u64), at);
            let photon = if later(photon, (pulse, time)) {
                photon
            } else {
                (pulse, time)
            };
            let first = own
                .pending
                .iter()
                .enumerate()
                .reduce(|a, b| if later(*a.1, *b.1) { b } else { a });
            let event = match first.map(|(k, t)| (k, *t)) {
                Some((k, after)) if later(photon, after) => {
                    own.pending.swap_remove(k);
                    after
                }
                _ => photon,
            };
            if event.0 >= self.pulses {
                return;
            }
            if let Some(count) = counts.get_mut(event.1 as usize) {
                *count += 1;
            }
            let alive = self.moved(event, self.dead);
            if let Some((p, decay)) = self.after
                && draws.uniform() < p
            {
                let delay = -decay * libm::log(1.0 - draws.uniform());
                own.pending.push(self.moved(alive, delay));
            }
            (pulse, time) = alive;
            own.pending.retain(|after| !later(alive, *after));
        }
    }

    fn moved(&self, (pulse, time): (u64, f64), by: f64) -> (u64, f64) {
        let to = time + by;
        let periods = libm::floor(to / self.period);
        let rest = (to - periods * self.period).clamp(0.0, self.period);
        (pulse.saturating_add(periods as u64), rest)
    }
}

/// Whether `a` is after `b`.
fn later(a: (u64, f64), b: (u64, f64)) -> bool {
    a.0 > b.0 || (a.0 == b.0 && a.1 > b.1)
}
