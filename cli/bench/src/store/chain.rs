//! zarrs' codec chains over plain bytes, and the division of an image into chunks.

use std::{borrow::Cow, num::NonZeroU64};

use serde_json::{Value, json};
use zarrs::array::codec::CodecChain;
use zarrs::array::codec::api::{ArrayToBytesCodecTraits, CodecOptions};
use zarrs::array::{ArrayBytes, DataType, FillValue, data_type};

use picofarm_cli::error::{CliError, Code, Result};

/// A chain of Zarr v3 codecs for chunks of 16- or 32-bit values.
pub struct Chain {
    chain: CodecChain,
    size: usize,
}

/// Returns the codecs for zstd or lz4 in blosc, behind a filter.
pub fn blosc(cname: &str, level: u32, shuffle: &str, size: usize, blocksize: usize) -> Value {
    json!([
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "blosc", "configuration": {
            "cname": cname, "clevel": level, "shuffle": shuffle, "typesize": size, "blocksize": blocksize,
        }},
        {"name": "crc32c"},
    ])
}

/// Returns the codecs for zstd alone.
pub fn zstd(level: i32) -> Value {
    json!([
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "zstd", "configuration": {"level": level, "checksum": false}},
        {"name": "crc32c"},
    ])
}

impl Chain {
    /// Creates a chain for values of `size` bytes.
    ///
    /// # Panics
    /// If this program lacks one of the codecs.
    pub fn new(codecs: &Value, size: usize) -> Self {
        let metadata: Vec<zarrs::metadata::v3::MetadataV3> =
            serde_json::from_value(codecs.clone()).expect("well-formed codecs");
        let chain = CodecChain::from_metadata(&metadata).expect("codecs of this program");
        Self { chain, size }
    }

    fn kind(&self) -> (DataType, FillValue) {
        let kind = match self.size {
            2 => data_type::uint16(),
            _ => data_type::float32(),
        };
        (kind, FillValue::from(vec![0u8; self.size]))
    }

    fn shape(&self, values: usize) -> Result<[NonZeroU64; 1]> {
        let n = NonZeroU64::new(values as u64);
        n.map(|n| [n]).ok_or_else(|| broken("an empty chunk"))
    }

    pub fn encode(&self, values: &[u8]) -> Result<Vec<u8>> {
        let (kind, fill) = self.kind();
        let shape = self.shape(values.len() / self.size)?;
        let bytes = ArrayBytes::from(Cow::Borrowed(values));
        let options = CodecOptions::default();
        let coded = self.chain.encode(bytes, &shape, &kind, &fill, &options);
        coded.map(Cow::into_owned).map_err(broken)
    }

    /// Decodes a chunk. `values` = number of values.
    pub fn decode(&self, bytes: &[u8], values: usize) -> Result<Vec<u8>> {
        let (kind, fill) = self.kind();
        let shape = self.shape(values)?;
        let bytes = Cow::Borrowed(bytes);
        let options = CodecOptions::default();
        let decoded = self.chain.decode(bytes, &shape, &kind, &fill, &options);
        let fixed = decoded.map_err(broken)?.into_fixed().map_err(broken)?;
        Ok(fixed.into_owned())
    }
}

/// Returns the error of a codec that failed.
pub fn broken(what: impl std::fmt::Display) -> CliError {
    CliError::new(Code::Failed, format!("a codec broke: {what}"))
}

/// An image of histograms divided into chunks. Chunks at the edges are smaller.
#[derive(Debug, Clone, Copy)]
pub struct Cut {
    /// Rows, columns, bins.
    pub image: [usize; 3],
    pub chunk: [usize; 3],
    /// Whether values are stored bin by bin within a chunk.
    pub bins_first: bool,
}

impl Cut {
    /// Returns corner and size of each chunk.
    pub fn chunks(self) -> impl Iterator<Item = ([usize; 3], [usize; 3])> {
        let starts = move |axis: usize| (0..self.image[axis]).step_by(self.chunk[axis]);
        let size = move |at: [usize; 3]| {
            [0, 1, 2].map(|axis| self.chunk[axis].min(self.image[axis] - at[axis]))
        };
        starts(0)
            .flat_map(move |r| starts(1).flat_map(move |c| starts(2).map(move |b| [r, c, b])))
            .map(move |at| (at, size(at)))
    }

    /// Calls `call` with the position of each histogram's part in the image, and in the chunk.
    fn each(self, (at, size): ([usize; 3], [usize; 3]), mut call: impl FnMut(usize, usize)) {
        for r in 0..size[0] {
            for c in 0..size[1] {
                let pixel = (at[0] + r) * self.image[1] + at[1] + c;
                call(pixel * self.image[2] + at[2], r * size[1] + c);
            }
        }
    }

    pub fn gather<T: Copy + Default>(self, of: ([usize; 3], [usize; 3]), from: &[T]) -> Vec<T> {
        let (pixels, bins) = (of.1[0] * of.1[1], of.1[2]);
        let mut chunk = vec![T::default(); pixels * bins];
        self.each(of, |at, pixel| {
            let source = &from[at..at + bins];
            if self.bins_first {
                let places = chunk[pixel..].iter_mut().step_by(pixels);
                places.zip(source).for_each(|(to, from)| *to = *from);
            } else {
                chunk[pixel * bins..][..bins].copy_from_slice(source);
            }
        });
        chunk
    }

    pub fn scatter<T: Copy>(self, of: ([usize; 3], [usize; 3]), chunk: &[T], to: &mut [T]) {
        let (pixels, bins) = (of.1[0] * of.1[1], of.1[2]);
        self.each(of, |at, pixel| {
            let target = &mut to[at..at + bins];
            if self.bins_first {
                let places = chunk[pixel..].iter().step_by(pixels);
                target
                    .iter_mut()
                    .zip(places)
                    .for_each(|(to, from)| *to = *from);
            } else {
                target.copy_from_slice(&chunk[pixel * bins..][..bins]);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_cut_is_put_together_again() {
        for bins_first in [false, true] {
            let cut = Cut {
                image: [5, 7, 11],
                chunk: [4, 3, 6],
                bins_first,
            };
            let image: Vec<u16> = (0..5 * 7 * 11).collect();
            let mut back = vec![0u16; image.len()];
            let chain = Chain::new(&blosc("zstd", 1, "shuffle", 2, 0), 2);
            for of in cut.chunks() {
                let chunk = cut.gather(of, &image);
                let coded = chain.encode(bytemuck::cast_slice(&chunk)).unwrap();
                let decoded = chain.decode(&coded, chunk.len()).unwrap();
                cut.scatter(of, bytemuck::cast_slice::<u8, u16>(&decoded), &mut back);
            }
            assert_eq!(back, image);
        }
    }
}
