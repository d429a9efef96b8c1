//! The likely size of a pixel's error, which its standard error alone does not tell.
//!
//! The standard error is a quadratic mean. If one path brings light to many bins at once, a few
//! random events determine the pixel's error: most pixels err by less than their standard error,
//! and few by much more. So some pixels are *watched*: they store the sum over every eighth pass,
//! both of the tiles' contributions and of those that light paths draw into the image. Differences
//! of these sums are draws of the pixel's error, with all correlations between its bins, and the
//! median over pixels is taken of them.

use crate::render::{region::Region, stat::Stat};

/// The number of sums, each over every eighth pass, and of their independent differences.
const PHASES: usize = 8;
const DRAWS: usize = PHASES - 1;

/// One pixel in this many rows and columns is watched.
const APART: u32 = 3;

/// The minimum number of watched pixels for an estimate.
const LEAST: usize = 16;

/// ‖draw of a pixel's error‖² over the bins, for each draw.
pub(crate) type Draw = [f64; DRAWS];

/// Sums over every eighth pass.
pub(crate) type Sums = [f32; PHASES];

/// Converts sums over every eighth pass to draws of the error of the mean over all passes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Phases {
    /// Weight of each phase's sum in a draw.
    weights: [f64; PHASES],
}

impl Phases {
    /// Returns the weights for this number of passes, or `None` if a phase has no pass.
    pub fn of(passes: u32) -> Option<Self> {
        if !are_drawn(passes) {
            return None;
        }
        // Means over the passes of each phase. A phase has n/8 of the n passes, or one more.
        let n = |phase: usize| (passes as usize + PHASES - 1 - phase) / PHASES;
        let spread: f64 = (0..PHASES).map(|phase| 1.0 / n(phase) as f64).sum();
        // The mean of all passes has 1/passes of the variance of a pass.
        let factor = (1.0 / (f64::from(passes) * spread)).sqrt();
        Some(Self {
            weights: std::array::from_fn(|phase| factor / n(phase) as f64),
        })
    }

    /// Returns the phase of a pass.
    pub fn phase(pass: u32) -> usize {
        pass as usize % PHASES
    }

    /// Adds a bin with these sums to a pixel's draws.
    pub fn add(&self, sums: Sums, draw: &mut Draw) {
        let mean = |phase: usize| f64::from(sums[phase]) * self.weights[phase];
        let means: [f64; PHASES] = std::array::from_fn(mean);
        for (k, square) in draw.iter_mut().enumerate() {
            let signed = means.iter().enumerate().map(|(j, m)| sign(k, j) * m);
            *square += signed.sum::<f64>().powi(2);
        }
    }
}

/// Returns a draw of the error of two parts that err independently: on average their squares add
/// up.
pub(crate) fn joined(draw: Draw, other: f64) -> Draw {
    draw.map(|square| square + other)
}

/// Returns whether there are enough passes for draws of their own.
pub(crate) fn are_drawn(passes: u32) -> bool {
    passes as usize >= PHASES
}

/// Returns a draw from a pixel's variance alone.
pub(crate) fn of_variance(variance: f64) -> Draw {
    [variance; DRAWS]
}

/// The sums of the watched pixels of a tile.
#[derive(Debug, Default)]
pub(crate) struct Watched {
    /// Index of the watched pixel, by pixel of the tile.
    pub places: Vec<Option<u32>>,
    /// The watched pixels.
    pub pixels: Vec<usize>,
    pub slots: usize,
    /// `[watched][phase][slot]`: Σ over passes of the 3+ part.
    pub sums: Vec<f32>,
    /// `[watched][slot]`: a draw of the two-bounce part's error.
    pub two: Vec<f32>,
}

/// Returns whether pixel `k` of a region is watched.
pub(crate) fn is_watched(region: &Region, k: usize) -> bool {
    let chosen = |i: u32| i % APART == APART / 2;
    let (row, col) = (k as u32 / region.cols, k as u32 % region.cols);
    chosen(region.row + row) && chosen(region.col + col)
}

/// Returns the watched pixels of a region.
pub(crate) fn watched(region: &Region) -> impl Iterator<Item = usize> + '_ {
    (0..region.pixels()).filter(|&k| is_watched(region, k))
}

/// Returns the number of watched pixels of a region.
pub(crate) fn count(region: &Region) -> usize {
    watched(region).count()
}

/// Returns the sign of a phase in a draw. The signs are rows of a Hadamard matrix, so draws are
/// independent of the mean and of each other.
fn sign(draw: usize, phase: usize) -> f64 {
    match ((draw + 1) & phase).count_ones() % 2 {
        0 => 1.0,
        _ => -1.0,
    }
}

impl Watched {
    /// Clears the sums and prepares them for a region.
    pub fn reset(&mut self, region: &Region, slots: usize) {
        self.slots = slots;
        self.pixels.clear();
        self.pixels.extend(watched(region));
        self.places.clear();
        self.places.resize(region.pixels(), None);
        for (place, &k) in self.pixels.iter().enumerate() {
            self.places[k] = Some(place as u32);
        }
        for (list, of_pixel) in [(&mut self.sums, PHASES), (&mut self.two, 1)] {
            list.clear();
            list.resize(self.pixels.len() * of_pixel * slots, 0.0);
        }
    }

    /// Returns the watched pixels of the region, ascending.
    pub fn pixels(&self) -> &[usize] {
        &self.pixels
    }

    /// Adds a pass over pixel `k`, if the pixel is watched.
    #[inline]
    pub fn add(&mut self, k: usize, pass: u32, values: &[f32]) {
        let Some(place) = self.places[k] else { return };
        let phase = place as usize * PHASES + Phases::phase(pass);
        let sum = &mut self.sums[phase * self.slots..(phase + 1) * self.slots];
        for (sum, v) in sum.iter_mut().zip(values) {
            *sum += v;
        }
    }

    /// Stores a draw of the error of pixel `k`'s two-bounce part, `factor` times `noise`, if the
    /// pixel is watched.
    pub fn two(&mut self, k: usize, noise: &[f32], factor: f32) {
        let Some(place) = self.places[k] else { return };
        let two = &mut self.two[place as usize * self.slots..][..self.slots];
        for (two, v) in two.iter_mut().zip(noise) {
            *two = v * factor;
        }
    }

    /// Returns draws of the errors of the watched pixels' 3+ part after this number of passes. With
    /// fewer than eight passes, each draw is the variance `multi_variance` of the pixel of the
    /// region.
    pub fn draws(&self, passes: u32, multi_variance: impl Fn(usize) -> f64) -> Vec<Draw> {
        let phases = Phases::of(passes);
        let pixels = self.pixels.iter().enumerate();
        let each = pixels.map(|(place, &k)| {
            let Some(phases) = &phases else {
                return of_variance(multi_variance(k));
            };
            let mut draw = Draw::default();
            for slot in 1..self.slots.max(2) - 1 {
                let sum = |phase: usize| self.sums[(place * PHASES + phase) * self.slots + slot];
                phases.add(std::array::from_fn(sum), &mut draw);
            }
            draw
        });
        each.collect()
    }

    /// Returns ‖draw of the two-bounce part's error‖² of the watched pixels.
    pub fn two_draws(&self) -> Vec<f64> {
        let slots = self.slots.max(1);
        let each = self.two.chunks(slots).map(|two| {
            let inside = &two[1..slots.max(2) - 1];
            inside.iter().map(|&x| f64::from(x).powi(2)).sum()
        });
        each.collect()
    }
}

/// Returns the ratio of the `q`-quantile of the errors over pixels to that of the standard errors.
/// `draws` are those of some pixels of `stats`. Returns 1 if too few pixels are watched.
pub(crate) fn likely(stats: &[Stat], draws: &[(usize, Draw)], q: f64) -> f64 {
    let (mut stated, mut drawn) = (vec![], vec![]);
    for (pixel, draw) in draws {
        let stat = &stats[*pixel];
        let variance = stat.two_variance + stat.multi_variance;
        if let Some(error) = stat.error() {
            stated.push(error);
            let of = |square: &f64| match variance > 0.0 {
                true => error * (square / variance).sqrt(),
                false => 0.0,
            };
            drawn.extend(draw.iter().map(of));
        }
    }
    let quantile = |list: &mut Vec<f64>| {
        list.sort_by(f64::total_cmp);
        list[((list.len() - 1) as f64 * q).round() as usize]
    };
    if stated.len() < LEAST {
        return 1.0;
    }
    match quantile(&mut stated) {
        0.0 => 1.0,
        stated => quantile(&mut drawn) / stated,
    }
}

#[cfg(test)]
mod tests {
    use crate::numeric::rng::Rng;
    use crate::numeric::rng::Stream;
    use crate::render::draws::Draw;
    use crate::render::draws::Watched;
    use crate::render::draws::count;
    use crate::render::draws::likely;
    use crate::render::region::Region;
    use crate::render::stat::Stat;

    const SLOTS: usize = 42;

    fn region() -> Region {
        Region {
            row: 16,
            col: 48,
            rows: 18,
            cols: 18,
        }
    }

    /// Returns draws and variances of pixels after `passes` passes with the values from `value`.
    fn drawn(passes: u32, mut value: impl FnMut(&mut Rng) -> Vec<f32>) -> (Vec<Draw>, Vec<f64>) {
        let mut watched = Watched::default();
        watched.reset(&region(), SLOTS);
        let mut rng = Rng::new(1, Stream::Paths, 0, 0);
        let mut variances = vec![];
        let pixels = watched.pixels().to_vec();
        for &k in &pixels {
            let all: Vec<Vec<f32>> = (0..passes).map(|_| value(&mut rng)).collect();
            for (pass, values) in all.iter().enumerate() {
                watched.add(k, pass as u32, values);
            }
            let n = f64::from(passes);
            let of_slot = |slot: usize| {
                let at = || all.iter().map(|v| f64::from(v[slot]));
                let mean = at().sum::<f64>() / n;
                at().map(|x| (x - mean).powi(2)).sum::<f64>() / (n * (n - 1.0))
            };
            variances.push((1..SLOTS - 1).map(of_slot).sum());
        }
        (watched.draws(passes, |_| 0.0), variances)
    }

    fn apart(rng: &mut Rng) -> Vec<f32> {
        (0..SLOTS).map(|_| rng.uniform()).collect()
    }

    fn together(rng: &mut Rng) -> Vec<f32> {
        vec![rng.uniform(); SLOTS]
    }

    #[test]
    fn draws_have_the_variance_of_the_mean() {
        // With eight passes, the draws contain everything except the mean, up to rounding.
        let (draws, variances) = drawn(8, apart);
        for (draw, variance) in draws.iter().zip(&variances) {
            let mean = draw.iter().sum::<f64>() / draw.len() as f64;
            assert!((mean / variance - 1.0).abs() < 1e-5, "{mean} {variance}");
        }
        // With other numbers of passes, they do so on average.
        for passes in [9, 13, 64, 101] {
            let (draws, variances) = drawn(passes, apart);
            let all: f64 = draws.iter().flatten().sum();
            let ratio = all / 7.0 / variances.iter().sum::<f64>();
            assert!((ratio - 1.0).abs() < 0.05, "{passes}: {ratio}");
        }
    }

    #[test]
    fn pixels_whose_bins_err_together_err_by_less_than_their_standard_error() {
        let factor = |(draws, variances): (Vec<Draw>, Vec<f64>)| {
            let stat = |&variance: &f64| Stat {
                norm2: 100.0,
                multi_variance: variance,
                ..Stat::default()
            };
            let stats: Vec<Stat> = variances.iter().map(stat).collect();
            let draws: Vec<_> = draws.into_iter().enumerate().collect();
            likely(&stats, &draws, 0.5)
        };
        let f = factor(drawn(64, apart));
        assert!((f - 1.0).abs() < 0.03, "{f}");
        // The median of a normal variable's absolute value is 0.674 of its standard deviation.
        let f = factor(drawn(64, together));
        assert!((f - 0.674).abs() < 0.1, "{f}");
    }

    #[test]
    fn few_pixels_say_nothing() {
        let draws = [(0, [0.25; 7])];
        let stats = [Stat {
            norm2: 100.0,
            multi_variance: 1.0,
            ..Stat::default()
        }];
        assert_eq!(likely(&stats, &draws, 0.5), 1.0);
        assert_eq!(likely(&[], &[], 0.5), 1.0);
    }

    #[test]
    fn which_pixels_are_watched_does_not_depend_on_the_tile() {
        let of = |rows: u32, cols: u32| {
            let part = |row, col| Region {
                row,
                col,
                rows,
                cols,
            };
            let parts = (0..36 / rows).flat_map(|r| (0..36 / cols).map(move |c| (r, c)));
            parts
                .map(|(r, c)| count(&part(r * rows, c * cols)))
                .sum::<usize>()
        };
        assert_eq!((of(36, 36), of(4, 6), of(1, 1)), (144, 144, 144));
    }
}
