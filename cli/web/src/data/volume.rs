//! A scene's histograms as a volume for graphics cards: 16-bit codes, one image for each bin.
//!
//! The code is the square root of h in steps of 1/`factor`. For the data sets' square-root profile
//! this is the stored code itself, so nothing is lost; h = (code/factor)². A small level of at most
//! 64×64 pixels is sent first, and the full volume in slabs of bins after it.

use std::path::PathBuf;

use http::StatusCode;
use picofarm_dataset::{Dataset, DatasetSpec, Profile, Quantity as Q};
use picofarm_figures::scene::quantile;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::light::{Light, lights, parts};
use crate::answer::Problem;

/// Longest side of the small level.
const SMALL: usize = 64;
/// Most values of a volume: a GiB while it is read.
const MOST: u64 = 1 << 28;

/// A volume in memory.
pub struct Volume {
    spec: DatasetSpec,
    factor: f64,
    /// Little-endian codes, `[bin][row][column]`.
    codes: Vec<u8>,
    small: Small,
}

/// The small level.
struct Small {
    width: usize,
    height: usize,
    /// Little-endian codes, `[bin][row][column]`.
    codes: Vec<u8>,
    /// The bins between the first light and most of it.
    lively: [usize; 2],
    /// h of a bright pixel of one bin.
    white: f32,
    /// Sum of h over the image, for each bin, without the brightest pixels.
    energy: Vec<f64>,
}

impl Volume {
    /// Reads the light of a scene.
    ///
    /// # Errors
    /// Fails if the data set has no such light, if it is too large, or if it cannot be read.
    pub async fn read(
        dataset: Dataset,
        folder: Option<PathBuf>,
        scene: u64,
        light: Light,
    ) -> Result<Self, Problem> {
        let spec = *dataset.spec();
        let values = spec.transient_len() as u64;
        if values > MOST {
            let what = format!(
                "{}x{} pixels with {} bins are {values} values; volumes have at most {MOST}",
                spec.width, spec.height, spec.gate.bins
            );
            return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, what));
        }
        let handle = tokio::runtime::Handle::current();
        let made = tokio::task::spawn_blocking(move || {
            let scale = handle.block_on(dataset.manifest(scene))?.scale;
            let planes = handle.block_on(planes(&dataset, folder, scene, light))?;
            Ok(Self::of(spec, scale, &planes))
        });
        let broken = |e| {
            let status = StatusCode::INTERNAL_SERVER_ERROR;
            Problem::new(status, format!("reading a volume broke: {e}"))
        };
        made.await.map_err(broken)?
    }

    /// Codes h, `[bin][row][column]`.
    fn of(spec: DatasetSpec, scale: f32, planes: &[f32]) -> Self {
        let factor = match spec.profile {
            Profile::SqrtU16 { delta } => 2.0 / f64::from(delta) * f64::from(scale).sqrt(),
            _ => {
                let most = planes.par_iter().copied().reduce(|| 0.0, f32::max);
                65_535.0 / f64::from(most.max(f32::MIN_POSITIVE)).sqrt()
            }
        };
        let pixels = spec.pixels().max(1);
        let (shape, small) = Small::shape(&spec);
        let mut codes = vec![0; 2 * planes.len()];
        let mut means = vec![0.0; small * planes.len() / pixels];
        let bins = codes.par_chunks_mut(2 * pixels);
        let bins = bins.zip(means.par_chunks_mut(small));
        // One pass over each image, while it is in the cache.
        bins.zip(planes.par_chunks(pixels))
            .for_each(|((codes, means), values)| {
                for (code, value) in codes.chunks_exact_mut(2).zip(values) {
                    code.copy_from_slice(&encode(*value, factor as f32));
                }
                shape.means(values, means);
            });
        Self {
            small: Small::of(&shape, factor as f32, &means),
            spec,
            factor,
            codes,
        }
    }

    /// Returns the size in memory.
    pub fn bytes(&self) -> usize {
        self.codes.len() + self.small.codes.len()
    }

    /// Returns sizes, times and exposure.
    pub fn facts(&self) -> Value {
        let gate = &self.spec.gate;
        json!({
            "width": self.spec.width, "height": self.spec.height, "bins": gate.bins,
            "start_m": gate.start_m, "bin_m": gate.bin_width_m, "factor": self.factor,
            "small": {"width": self.small.width, "height": self.small.height},
            "lively": self.small.lively, "white": self.small.white, "energy": self.small.energy,
        })
    }

    /// Returns the small level.
    pub fn coarse(&self) -> &[u8] {
        &self.small.codes
    }

    /// Returns the bins from `from` to `to` of the full volume.
    ///
    /// # Errors
    /// Fails if there are no such bins.
    pub fn slab(&self, from: u64, to: u64) -> Result<&[u8], Problem> {
        let bins = u64::from(self.spec.gate.bins);
        if from >= to || to > bins {
            let what = format!("from, to: expected bins within 0..{bins}, found {from}..{to}");
            return Err(Problem::input(what));
        }
        let bin = 2 * self.spec.pixels();
        Ok(&self.codes[from as usize * bin..to as usize * bin])
    }

    /// Returns h of a pixel, for each bin.
    pub fn histogram(&self, pixel: usize) -> Vec<f32> {
        let bins = self.codes.chunks_exact(2 * self.spec.pixels().max(1));
        bins.map(|codes| decode([codes[2 * pixel], codes[2 * pixel + 1]], self.factor))
            .collect()
    }
}

fn encode(value: f32, factor: f32) -> [u8; 2] {
    // The conversion ends at 65,535.
    ((factor * value.max(0.0).sqrt() + 0.5) as u16).to_le_bytes()
}

fn decode(code: [u8; 2], factor: f64) -> f32 {
    (f64::from(u16::from_le_bytes(code)) / factor).powi(2) as f32
}

/// Reads h as one image for each bin. Blocks its thread.
async fn planes(
    dataset: &Dataset,
    folder: Option<PathBuf>,
    scene: u64,
    light: Light,
) -> Result<Vec<f32>, Problem> {
    let folder = folder.as_deref();
    if lights(dataset.spec(), folder)
        .iter()
        .all(|(kind, _)| *kind != light)
    {
        return Err(Problem::missing(match light {
            Light::Two | Light::More => {
                "light: only `picofarm scene render --split` stores two bounces and more apart"
                    .into()
            }
            light => format!(
                "light: this data set stores no light {:?} of its own",
                light.name()
            ),
        }));
    }
    let quantity = match light {
        Light::All => Q::Transient,
        Light::Four => Q::Transient4,
        Light::TwentyFive => Q::Transient25,
        Light::Spot(spot) => {
            let values = dataset.read_spot(scene, spot).await?;
            return Ok(by_bin(&values, dataset.spec()));
        }
        Light::Two | Light::More => {
            let name = if light == Light::Two { "two" } else { "multi" };
            let group = folder.and_then(parts).filter(|group| group.has(name));
            let missing = || Problem::missing(format!("light: {name} was removed meanwhile"));
            let group = group.ok_or_else(missing)?;
            let (shape, values) = group.read::<f32>(name)?;
            let spec = dataset.spec();
            let expected = [spec.height, spec.width, spec.gate.bins].map(u64::from);
            if shape != expected {
                let what = format!("{name}: expected the shape {expected:?}, found {shape:?}");
                return Err(Problem::input(what));
            }
            return Ok(by_bin(&values, spec));
        }
    };
    let mut target = Vec::new();
    dataset
        .read_planes_into(scene, quantity, &mut target)
        .await?;
    Ok(target)
}

/// Turns `[row][column][bin]` into `[bin][row][column]`.
fn by_bin(values: &[f32], spec: &DatasetSpec) -> Vec<f32> {
    let (pixels, bins) = (spec.pixels(), spec.gate.bins as usize);
    let mut planes = vec![0.0; values.len()];
    let images = planes.par_chunks_mut(pixels.max(1)).enumerate();
    images.for_each(|(bin, image)| {
        for (pixel, value) in image.iter_mut().enumerate() {
            *value = values[pixel * bins + bin];
        }
    });
    planes
}

/// Blocks of pixels.
struct Blocks {
    /// Of the full image.
    size: [usize; 2],
    step: usize,
    width: usize,
    height: usize,
}

impl Blocks {
    /// Sets `means` to the mean of each block of an image.
    fn means(&self, image: &[f32], means: &mut [f32]) {
        let [w, h] = self.size;
        for (y, line) in means.chunks_exact_mut(self.width).enumerate() {
            let rows = y * self.step..h.min((y + 1) * self.step);
            line.fill(0.0);
            for row in rows.clone() {
                let parts = image[row * w..][..w].chunks(self.step);
                for (mean, part) in line.iter_mut().zip(parts) {
                    *mean += part.iter().sum::<f32>();
                }
            }
            for (x, mean) in line.iter_mut().enumerate() {
                let columns = w.min((x + 1) * self.step) - x * self.step;
                *mean /= (rows.len() * columns) as f32;
            }
        }
    }
}

impl Small {
    /// Returns the blocks, and their number.
    fn shape(spec: &DatasetSpec) -> (Blocks, usize) {
        let (w, h) = (spec.width as usize, spec.height as usize);
        let step = w.max(h).div_ceil(SMALL).max(1);
        let blocks = Blocks {
            size: [w, h],
            step,
            width: w.div_ceil(step),
            height: h.div_ceil(step),
        };
        let count = (blocks.width * blocks.height).max(1);
        (blocks, count)
    }

    /// Makes the level from the means of the blocks, `[bin][row][column]`.
    fn of(blocks: &Blocks, factor: f32, means: &[f32]) -> Self {
        let (width, height) = (blocks.width, blocks.height);
        let pixels = (width * height).max(1);
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
            codes: means.iter().flat_map(|h| encode(*h, factor)).collect(),
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

#[cfg(test)]
mod tests {
    use picofarm_dataset::{Gate, Subsets, Wavelength};

    use super::*;

    fn spec(width: u32, height: u32, bins: u32, profile: Profile) -> DatasetSpec {
        DatasetSpec {
            scenes: 1,
            height,
            width,
            spots: 1,
            subsets: Subsets::NONE,
            per_spot: false,
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
            gate: Gate {
                start_m: 0.0,
                bin_width_m: 0.1,
                bins,
            },
            profile,
        }
    }

    #[test]
    fn codes_give_the_values_of_each_pixel_back_in_any_profile() {
        for profile in [Profile::default(), Profile::LOSSLESS] {
            let spec = spec(3, 2, 4, profile);
            let planes: Vec<f32> = (0..24).map(|i| (i * i) as f32).collect();
            let volume = Volume::of(spec, 1.0, &planes);
            for pixel in 0..6 {
                for (bin, h) in volume.histogram(pixel).into_iter().enumerate() {
                    let exact = planes[bin * 6 + pixel];
                    assert!(
                        (h - exact).abs() <= 0.05 * exact.sqrt() + 0.01,
                        "{h} {exact}"
                    );
                }
            }
            assert_eq!(volume.slab(1, 3).unwrap(), &volume.codes[12..36]);
            assert!(volume.slab(1, 5).is_err() && volume.slab(2, 2).is_err());
        }
    }

    #[test]
    fn the_small_level_has_the_means_of_blocks_also_at_the_edges() {
        let spec = spec(129, 65, 2, Profile::default());
        let volume = Volume::of(spec, 1.0, &vec![4.0; 129 * 65 * 2]);
        assert_eq!((volume.small.width, volume.small.height), (43, 22));
        let codes = volume.small.codes.chunks_exact(2);
        for code in codes {
            assert_eq!(decode([code[0], code[1]], volume.factor), 4.0);
        }
    }

    #[test]
    fn darkness_has_a_volume_too() {
        let volume = Volume::of(spec(4, 4, 8, Profile::LOSSLESS), 1.0, &[0.0; 128]);
        assert_eq!(volume.small.lively, [0, 8]);
        assert!(volume.histogram(3).iter().all(|h| *h == 0.0));
    }
}
