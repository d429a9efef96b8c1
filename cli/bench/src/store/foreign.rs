//! Foreign formats: floats and halves behind general-purpose compressors, pcodec, OpenEXR, HDF5.

use std::io::Cursor;

use exr::prelude::{
    AnyChannel, AnyChannels, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes,
    ReadChannels, ReadLayers, SmallVec, WritableImage, read,
};
use half::f16;
use hdf5_pure::{File, FileBuilder};

use super::{
    chain::{Chain, Cut, blosc, broken, zstd},
    sample::Sample,
};
use picofarm_cli::error::Result;

/// A format for floats or halves.
#[derive(Debug, Clone, Copy)]
pub enum Foreign {
    Zstd32(i32),
    Zstd16(i32),
    Blosc32,
    Blosc16,
    Pco32,
    /// As written by `dataset export --format sb3d`.
    ExrHalf,
    /// Shuffle and deflate of this level, in chunks of the same shape.
    Hdf5(u32),
}

const CHUNK: usize = 32;
/// Upper limit of the scaled brightest value, because halves end at 65,504.
const BRIGHTEST: f32 = 32_768.0;

impl Foreign {
    pub fn all() -> Vec<(&'static str, Self)> {
        vec![
            ("f32, zstd 1", Self::Zstd32(1)),
            ("f32, zstd 3", Self::Zstd32(3)),
            ("f32, blosc shuffle zstd 3", Self::Blosc32),
            ("f32, pcodec", Self::Pco32),
            ("f32, HDF5 shuffle gzip 4", Self::Hdf5(4)),
            ("f16, zstd 3", Self::Zstd16(3)),
            ("f16, blosc shuffle zstd 3", Self::Blosc16),
            ("f16, OpenEXR ZIP", Self::ExrHalf),
        ]
    }

    fn cut(sample: &Sample) -> Cut {
        Cut {
            image: [sample.height, sample.width, sample.bins],
            chunk: [CHUNK, CHUNK, sample.bins],
            bins_first: false,
        }
    }

    fn chain(self) -> Chain {
        match self {
            Self::Zstd32(level) => Chain::new(&zstd(level), 4),
            Self::Zstd16(level) => Chain::new(&zstd(level), 2),
            Self::Blosc16 => Chain::new(&blosc("zstd", 3, "shuffle", 2, 0), 2),
            _ => Chain::new(&blosc("zstd", 3, "shuffle", 4, 0), 4),
        }
    }

    pub fn encode(self, sample: &Sample) -> Result<Vec<Vec<u8>>> {
        let cut = Self::cut(sample);
        match self {
            Self::Zstd32(_) | Self::Blosc32 => {
                let chain = self.chain();
                let one = |of| chain.encode(bytemuck::cast_slice(&cut.gather(of, &sample.h)));
                cut.chunks().map(one).collect()
            }
            Self::Pco32 => {
                let config = pco::ChunkConfig::default();
                let one = |of| {
                    pco::standalone::simple_compress(&cut.gather(of, &sample.h), &config)
                        .map_err(broken)
                };
                cut.chunks().map(one).collect()
            }
            Self::Zstd16(_) | Self::Blosc16 => {
                let (chain, h) = (self.chain(), halves(sample));
                let one = |of| chain.encode(bytemuck::cast_slice(&cut.gather(of, &h)));
                cut.chunks().map(one).collect()
            }
            Self::ExrHalf => Ok(vec![exr(sample)?]),
            Self::Hdf5(level) => {
                let mut file = FileBuilder::new();
                let chunk = [
                    CHUNK.min(sample.height),
                    CHUNK.min(sample.width),
                    sample.bins,
                ];
                file.create_dataset("transient")
                    .with_f32_data(&sample.h)
                    .with_shape(&[sample.height, sample.width, sample.bins].map(|n| n as u64))
                    .with_chunks(&chunk.map(|n| n as u64))
                    .with_shuffle()
                    .with_deflate(level);
                Ok(vec![file.finish().map_err(broken)?])
            }
        }
    }

    pub fn decode(self, chunks: &[Vec<u8>], sample: &Sample, target: &mut [f32]) -> Result<()> {
        let cut = Self::cut(sample);
        let factor = factor(&sample.h);
        match self {
            Self::Zstd32(_) | Self::Blosc32 => {
                let chain = self.chain();
                for (of, bytes) in cut.chunks().zip(chunks) {
                    let values = chain.decode(bytes, of.1.iter().product())?;
                    cut.scatter(
                        of,
                        &bytemuck::pod_collect_to_vec::<u8, f32>(&values),
                        target,
                    );
                }
            }
            Self::Pco32 => {
                for (of, bytes) in cut.chunks().zip(chunks) {
                    let values: Vec<f32> =
                        pco::standalone::simple_decompress(bytes).map_err(broken)?;
                    cut.scatter(of, &values, target);
                }
            }
            Self::Zstd16(_) | Self::Blosc16 => {
                let chain = self.chain();
                for (of, bytes) in cut.chunks().zip(chunks) {
                    let values = chain.decode(bytes, of.1.iter().product())?;
                    let halves: Vec<f16> = bytemuck::pod_collect_to_vec(&values);
                    let values: Vec<f32> = halves.iter().map(|h| h.to_f32() / factor).collect();
                    cut.scatter(of, &values, target);
                }
            }
            Self::ExrHalf => {
                let image = read()
                    .no_deep_data()
                    .largest_resolution_level()
                    .all_channels()
                    .first_valid_layer()
                    .all_attributes()
                    .non_parallel()
                    .from_buffered(Cursor::new(&chunks[0]))
                    .map_err(broken)?;
                let samples = &image.layer_data.channel_data.list[0].sample_data;
                for (to, h) in target.iter_mut().zip(samples.values_as_f32()) {
                    *to = h / factor;
                }
            }
            Self::Hdf5(_) => {
                let file = File::from_bytes(chunks[0].clone()).map_err(broken)?;
                let values = file.dataset("transient").and_then(|d| d.read_f32());
                target.copy_from_slice(&values.map_err(broken)?);
            }
        }
        Ok(())
    }
}

fn halves(sample: &Sample) -> Vec<f16> {
    let factor = factor(&sample.h);
    sample.h.iter().map(|h| f16::from_f32(h * factor)).collect()
}

/// Returns the power of two that brings the brightest value to at most [`BRIGHTEST`].
fn factor(h: &[f32]) -> f32 {
    let brightest = h.iter().fold(f32::MIN_POSITIVE, |m, h| m.max(*h));
    2f32.powi((BRIGHTEST / brightest).log2().floor() as i32)
}

/// Encodes one channel of halves, one line per pixel.
fn exr(sample: &Sample) -> Result<Vec<u8>> {
    let mut channels = SmallVec::new();
    channels.push(AnyChannel::new("Y", FlatSamples::F16(halves(sample))));
    let encoding = Encoding {
        compression: Compression::ZIP16,
        blocks: exr::image::Blocks::ScanLines,
        line_order: exr::meta::attribute::LineOrder::Increasing,
    };
    let size = (sample.bins, sample.height * sample.width);
    let channels = AnyChannels::sort(channels);
    let layer = Layer::new(size, LayerAttributes::default(), encoding, channels);
    let mut bytes = Cursor::new(Vec::new());
    let written = Image::from_layer(layer)
        .write()
        .non_parallel()
        .to_buffered(&mut bytes);
    written.map_err(broken)?;
    Ok(bytes.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_gives_back_what_its_numbers_hold() {
        let h: Vec<f32> = (0..9 * 40 * 30)
            .map(|i| ((i * 7919) % 1013) as f32 * 3.7)
            .collect();
        let sample = Sample::plain(9, 40, 30, h, 2.0);
        for (name, foreign) in Foreign::all() {
            let coded = foreign.encode(&sample).unwrap();
            let mut back = vec![f32::NAN; sample.h.len()];
            foreign.decode(&coded, &sample, &mut back).unwrap();
            let exact = name.starts_with("f32");
            for (found, h) in back.iter().zip(&sample.h) {
                let bound = if exact { 0.0 } else { h / 2000.0 };
                assert!((found - h).abs() <= bound, "{name}: {found}, expected {h}");
            }
        }
    }
}
