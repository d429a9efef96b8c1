//! A scene's histograms as a volume for graphics cards: 16-bit codes, one image for each bin.
//!
//! The code is the square root of h in steps of 1/`factor`. For the data sets' square-root profile
//! this is the stored code itself, so nothing is lost; h = (code/factor)². A small level of at most
//! 64×64 pixels is sent first, and the full volume in slabs of bins after it.

use std::path::PathBuf;

use http::StatusCode;
use picofarm_dataset::{Dataset, DatasetSpec, Profile, Quantity as Q};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::{
    light::{Light, lights, parts},
    small::{Blocks, Small},
};
use crate::answer::Problem;

/// Most values of a volume: half a GiB, and a GiB more while values are coded.
const MOST: u64 = 1 << 28;

/// A volume in memory.
pub struct Volume {
    spec: DatasetSpec,
    factor: f64,
    /// Codes, `[bin][row][column]`. The bytes in memory are little-endian.
    codes: Vec<u16>,
    small: Small,
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
            let light = handle.block_on(stored(&dataset, folder, scene, light))?;
            Ok(match light {
                Stored::Codes { delta, codes } => {
                    Self::of_codes(spec, factor_of(delta, scale), codes)
                }
                Stored::Planes(planes) => Self::of_planes(spec, scale, &planes),
            })
        });
        let broken = |e| {
            let status = StatusCode::INTERNAL_SERVER_ERROR;
            Problem::new(status, format!("reading a volume broke: {e}"))
        };
        made.await.map_err(broken)?
    }

    /// Codes h, `[bin][row][column]`.
    fn of_planes(spec: DatasetSpec, scale: f32, planes: &[f32]) -> Self {
        let factor = match spec.profile {
            Profile::SqrtU16 { delta } => factor_of(delta, scale),
            _ => {
                let most = planes.par_iter().copied().reduce(|| 0.0, f32::max);
                65_535.0 / f64::from(most.max(f32::MIN_POSITIVE)).sqrt()
            }
        };
        let code = |value: &f32| encode(*value, factor as f32);
        Self::of_codes(spec, factor, planes.par_iter().map(code).collect())
    }

    /// Takes codes, `[bin][row][column]`.
    fn of_codes(spec: DatasetSpec, factor: f64, mut codes: Vec<u16>) -> Self {
        let pixels = spec.pixels().max(1);
        let blocks = Blocks::of(&spec);
        let mut means = vec![0.0; blocks.count() * codes.len() / pixels];
        let images = means.par_chunks_mut(blocks.count());
        images
            .zip(codes.par_chunks_mut(pixels))
            .for_each(|(means, image)| {
                blocks.means(image, factor, means);
                image.iter_mut().for_each(|code| *code = code.to_le());
            });
        Self {
            small: Small::of(&blocks, factor, &means),
            spec,
            factor,
            codes,
        }
    }

    /// Returns the size in memory.
    pub fn bytes(&self) -> usize {
        2 * self.codes.len() + self.small.codes.len()
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
        let bin = self.spec.pixels();
        let codes = &self.codes[from as usize * bin..to as usize * bin];
        Ok(bytemuck::cast_slice(codes))
    }

    /// Returns h of a pixel, for each bin.
    pub fn histogram(&self, pixel: usize) -> Vec<f32> {
        let images = self.codes.chunks_exact(self.spec.pixels().max(1));
        images.map(|image| self.decode(image[pixel])).collect()
    }

    /// Returns the sum of h over some bins, for each pixel.
    pub fn light_in(&self, bins: std::ops::Range<usize>) -> Vec<f32> {
        let pixels = self.spec.pixels();
        let images = &self.codes[bins.start * pixels..bins.end * pixels];
        let mut light = vec![0.0; pixels];
        for image in images.chunks_exact(pixels.max(1)) {
            for (sum, code) in light.iter_mut().zip(image) {
                *sum += self.decode(*code);
            }
        }
        light
    }

    /// Returns the bins between the first light and most of it.
    pub fn lively(&self) -> std::ops::Range<usize> {
        self.small.lively[0]..self.small.lively[1]
    }

    /// Returns h of a bright pixel of one bin.
    pub fn white(&self) -> f32 {
        self.small.white
    }

    /// Returns the properties of the data set.
    pub fn spec(&self) -> &DatasetSpec {
        &self.spec
    }

    fn decode(&self, code: u16) -> f32 {
        (f64::from(u16::from_le(code)) / self.factor).powi(2) as f32
    }
}

/// Returns codes per root of h in the square-root profile of step `delta`.
fn factor_of(delta: f32, scale: f32) -> f64 {
    2.0 / f64::from(delta) * f64::from(scale).sqrt()
}

/// Returns the code of h.
pub fn encode(value: f32, factor: f32) -> u16 {
    // The conversion ends at 65,535.
    (factor * value.max(0.0).sqrt() + 0.5) as u16
}

/// A scene's light as it is stored, one image for each bin.
enum Stored {
    /// Codes of the square-root profile of step `delta`.
    Codes { delta: f32, codes: Vec<u16> },
    /// h.
    Planes(Vec<f32>),
}

/// Reads light as one image for each bin. Blocks its thread.
async fn stored(
    dataset: &Dataset,
    folder: Option<PathBuf>,
    scene: u64,
    light: Light,
) -> Result<Stored, Problem> {
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
            return Ok(Stored::Planes(by_bin(&values, dataset.spec())));
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
            return Ok(Stored::Planes(by_bin(&values, spec)));
        }
    };
    if let Profile::SqrtU16 { delta } = dataset.spec().profile {
        let mut codes = Vec::new();
        dataset.read_codes_into(scene, quantity, &mut codes).await?;
        return Ok(Stored::Codes { delta, codes });
    }
    let mut planes = Vec::new();
    dataset
        .read_planes_into(scene, quantity, &mut planes)
        .await?;
    Ok(Stored::Planes(planes))
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
            let volume = Volume::of_planes(spec, 1.0, &planes);
            for pixel in 0..6 {
                for (bin, h) in volume.histogram(pixel).into_iter().enumerate() {
                    let exact = planes[bin * 6 + pixel];
                    assert!(
                        (h - exact).abs() <= 0.05 * exact.sqrt() + 0.01,
                        "{h} {exact}"
                    );
                }
            }
            let bytes: Vec<u8> = volume.codes[6..18]
                .iter()
                .flat_map(|code| code.to_ne_bytes())
                .collect();
            assert_eq!(volume.slab(1, 3).unwrap(), bytes);
            assert!(volume.slab(1, 5).is_err() && volume.slab(2, 2).is_err());
        }
    }

    #[test]
    fn the_small_level_has_the_means_of_blocks_also_at_the_edges() {
        let spec = spec(129, 65, 2, Profile::default());
        let volume = Volume::of_planes(spec, 1.0, &vec![4.0; 129 * 65 * 2]);
        assert_eq!((volume.small.width, volume.small.height), (43, 22));
        let codes = volume.small.codes.chunks_exact(2);
        for code in codes {
            let code = u16::from_le_bytes([code[0], code[1]]);
            assert_eq!((f64::from(code) / volume.factor).powi(2) as f32, 4.0);
        }
    }

    #[test]
    fn darkness_has_a_volume_too() {
        let volume = Volume::of_planes(spec(4, 4, 8, Profile::LOSSLESS), 1.0, &[0.0; 128]);
        assert_eq!(volume.small.lively, [0, 8]);
        assert!(volume.histogram(3).iter().all(|h| *h == 0.0));
    }
}
