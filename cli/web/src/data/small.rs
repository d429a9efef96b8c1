//! The small level of a volume: means of blocks of pixels, for the first picture.

use picofarm_dataset::DatasetSpec;
use picofarm_figures::scene::quantile;

use super::volume::encode;

/// Longest side of the small level.
const SIDE: usize = 64;

/// The small level.
pub struct Small {
    /// Width in blocks.
    pub width: usize,
    /// Height in blocks.
    pub height: usize,
    /// Little-endian codes, `[bin][row][column]`.
    pub codes: Vec<u8>,
    /// The bins between the first light and most of it.
    pub lively: [usize; 2],
    /// h of a bright pixel of one bin.
    pub white: f32,
    /// Sum of h over the image, for each bin, without the brightest pixels.
    pub energy: Vec<f64>,
}

/// Blocks of pixels.
pub struct Blocks {
    /// Of the full image.
    size: [usize; 2],
    step: usize,
    width: usize,
    height: usize,
}

impl Blocks {
    /// Returns the number of blocks of an image, at least 1.
    pub fn count(&self) -> usize {
        (self.width * self.height).max(1)
    }

    /// Sets `means` to the mean h of each block of an image of codes.
    pub fn means(&self, image: &[u16], factor: f64, means: &mut [f32]) {
        let [w, h] = self.size;
        let unit = (factor * factor).recip();
        let mut sums = vec![0u64; self.width];
        for (y, line) in means.chunks_exact_mut(self.width).enumerate() {
            let rows = y * self.step..h.min((y + 1) * self.step);
            sums.fill(0);
            for row in rows.clone() {
                let parts = image[row * w..][..w].chunks(self.step);
                for (sum, part) in sums.iter_mut().zip(parts) {
                    let squares = part.iter().map(|q| u64::from(*q) * u64::from(*q));
                    *sum += squares.sum::<u64>();
                }
            }
            for (x, (mean, sum)) in line.iter_mut().zip(&sums).enumerate() {
                let columns = w.min((x + 1) * self.step) - x * self.step;
                *mean = (*sum as f64 * unit / (rows.len() * columns) as f64) as f32;
            }
        }
    }
}

impl Blocks {
    /// Returns the blocks of a data set's images.
    pub fn of(spec: &DatasetSpec) -> Self {
        let (w, h) = (spec.width as usize, spec.height as usize);
        let step = w.max(h).div_ceil(SIDE).max(1);
        Self {
            size: [w, h],
            step,
            width: w.div_ceil(step),
            height: h.div_ceil(step),
        }
    }
}

impl Small {
    /// Makes the level from the means of the blocks, `[bin][row][column]`.
    pub fn of(blocks: &Blocks, factor: f64, means: &[f32]) -> Self {
        let (width, height) = (blocks.width, blocks.height);
        let pixels = blocks.count();
        let mut total = vec![0.0f32; pixels];
        for image in means.chunks_exact(pixels) {
            total.iter_mut().zip(image).for_each(|(t, h)| *t += h);
        }
        // Without the brightest pixels, which the spots themselves make.
        let limit = quantile(&total, 0.97);
        let energy: Vec<f64> = means
            .chunks_exact(pixels)
            .map(|image| {
                let kept = image.iter().zip(&total).filter(|(_, t)| **t <= limit);
                kept.map(|(h, _)| f64::from(*h)).sum()
            })
            .collect();
        let lively = lively(&energy);
        let probes: Vec<f32> = (1..8)
            .map(|k| lively[0] + (lively[1] - lively[0]) * k / 12)
            .filter_map(|bin| means.get(bin * pixels..(bin + 1) * pixels))
            .flatten()
            .copied()
            .filter(|h| *h > 0.0)
            .collect();
        Self {
            width,
            height,
            codes: means
                .iter()
                .flat_map(|h| encode(*h, factor as f32).to_le_bytes())
                .collect(),
            lively,
            white: quantile(&probes, 0.99).max(f32::MIN_POSITIVE),
            energy,
        }
    }
}

/// The bins between the first light and 95 % of it. Later there is only a faint, even glow.
fn lively(energy: &[f64]) -> [usize; 2] {
    let total: f64 = energy.iter().sum();
    let arrived = |share: f64| {
        let mut sum = 0.0;
        energy.iter().position(|e| {
            sum += e;
            sum > share * total
        })
    };
    match (arrived(1e-6), arrived(0.95)) {
        (Some(first), Some(last)) => [first.saturating_sub(2), (last + 1).min(energy.len())],
        _ => [0, energy.len()],
    }
}
