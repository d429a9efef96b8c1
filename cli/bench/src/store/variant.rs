//! Candidates for the default profile: quantisation, order of values, prediction, filters and
//! levels in any combination.

use serde_json::Value;

use super::{
    chain::{Chain, Cut, blosc, broken},
    sample::Sample,
};
use picofarm_cli::error::Result;

/// A square-root code of 16 bits in chunks.
#[derive(Debug, Clone)]
pub struct Variant {
    delta: f32,
    /// c in N = x² + 2cx, x = qΔ/2: 0 is the plain square root, ½ makes steps below one photon as
    /// large as above.
    offset: f32,
    /// Rows, columns, bins (0 = all).
    chunk: [usize; 3],
    bins_first: bool,
    predict: Predict,
    pack: Pack,
}

/// Encoded chunks, and the values too bright for a code: (flat index, value).
type Chunks = (Vec<Vec<u8>>, Vec<(u64, f32)>);

#[derive(Debug, Clone, Copy, PartialEq)]
enum Predict {
    No,
    /// From the previous bin.
    Time,
    /// From the previous column, within a chunk.
    Column,
}

#[derive(Debug, Clone)]
enum Pack {
    Zarr(Value),
    Pco,
}

const DELTA: f32 = 0.2;

impl Variant {
    /// Returns the tried variants by name. The first one is the profile of data sets of format 1,
    /// with the same Δ as the rest.
    pub fn all() -> Vec<(&'static str, Self)> {
        let zstd =
            |level, shuffle, blocksize| Pack::Zarr(blosc("zstd", level, shuffle, 2, blocksize));
        let old = Self {
            delta: DELTA,
            offset: 0.0,
            chunk: [32, 32, 0],
            bins_first: false,
            predict: Predict::No,
            pack: zstd(3, "bitshuffle", 0),
        };
        let new = Self {
            bins_first: true,
            chunk: [32, 32, 128],
            pack: zstd(3, "shuffle", 0),
            ..old.clone()
        };
        let predicted = |predict, like: &Self, pack| Self {
            predict,
            pack,
            ..like.clone()
        };
        vec![
            ("format 1, delta .2", old.clone()),
            (
                "format 1, delta .25",
                Self {
                    delta: 0.25,
                    ..old.clone()
                },
            ),
            (
                "format 1, shuffle",
                Self {
                    pack: zstd(3, "shuffle", 0),
                    ..old.clone()
                },
            ),
            (
                "format 1, zstd 5",
                Self {
                    pack: zstd(5, "bitshuffle", 0),
                    ..old.clone()
                },
            ),
            (
                "format 1, 32x32x128",
                Self {
                    chunk: [32, 32, 128],
                    ..old.clone()
                },
            ),
            (
                "format 1, 16x16",
                Self {
                    chunk: [16, 16, 0],
                    ..old.clone()
                },
            ),
            (
                "bins first, bitshuffle",
                Self {
                    pack: zstd(3, "bitshuffle", 0),
                    ..new.clone()
                },
            ),
            (
                "bins first, zstd 1",
                Self {
                    pack: zstd(1, "shuffle", 0),
                    ..new.clone()
                },
            ),
            (
                "bins first, zstd 5",
                Self {
                    pack: zstd(5, "shuffle", 0),
                    ..new.clone()
                },
            ),
            (
                "bins first, blocks 1 MB",
                Self {
                    pack: zstd(3, "shuffle", 1 << 20),
                    ..new.clone()
                },
            ),
            (
                "bins first, no blosc, zstd 3",
                Self {
                    pack: Pack::Zarr(super::chain::zstd(3)),
                    ..new.clone()
                },
            ),
            (
                "bins first, lz4",
                Self {
                    pack: Pack::Zarr(blosc("lz4", 5, "shuffle", 2, 0)),
                    ..new.clone()
                },
            ),
            (
                "bins first, 32x32x637",
                Self {
                    chunk: [32, 32, 0],
                    ..new.clone()
                },
            ),
            (
                "bins first, 16x16x128",
                Self {
                    chunk: [16, 16, 128],
                    ..new.clone()
                },
            ),
            (
                "bins first, 64x64x128",
                Self {
                    chunk: [64, 64, 128],
                    ..new.clone()
                },
            ),
            (
                "bins first, delta .25",
                Self {
                    delta: 0.25,
                    ..new.clone()
                },
            ),
            (
                "bins first, delta .3",
                Self {
                    delta: 0.3,
                    ..new.clone()
                },
            ),
            (
                "bins first, offset 1/2",
                Self {
                    offset: 0.5,
                    ..new.clone()
                },
            ),
            (
                "time prediction",
                predicted(Predict::Time, &old, zstd(3, "shuffle", 0)),
            ),
            (
                "column prediction",
                predicted(Predict::Column, &old, zstd(3, "bitshuffle", 0)),
            ),
            (
                "bins first, column prediction",
                predicted(Predict::Column, &new, zstd(3, "bitshuffle", 0)),
            ),
            (
                "bins first, pcodec",
                Self {
                    pack: Pack::Pco,
                    ..new
                },
            ),
        ]
    }

    /// Returns whether zarr-python and tensorstore both return the codes of individual bins.
    pub fn opens_plainly(&self) -> bool {
        self.predict == Predict::No && matches!(self.pack, Pack::Zarr(_))
    }

    fn cut(&self, sample: &Sample) -> Cut {
        let [rows, columns, bins] = self.chunk;
        Cut {
            image: [sample.height, sample.width, sample.bins],
            chunk: [rows, columns, if bins == 0 { sample.bins } else { bins }],
            bins_first: self.bins_first,
        }
    }

    fn code(&self, h: f32, scale: f32) -> u16 {
        let n = h * scale;
        let x = (n + self.offset * self.offset).sqrt() - self.offset;
        // The cast floors and saturates.
        (x * (2.0 / self.delta) + 0.5) as u16
    }

    fn value(&self, q: u16, scale: f32) -> f32 {
        let x = f32::from(q) * (self.delta * 0.5);
        (x * x + 2.0 * self.offset * x) / scale
    }

    pub fn encode(&self, sample: &Sample) -> Result<Chunks> {
        let mut q = vec![0u16; sample.h.len()];
        let mut exact = Vec::new();
        for (at, (q, h)) in q.iter_mut().zip(&sample.h).enumerate() {
            *q = self.code(*h, sample.scale);
            if *q == u16::MAX {
                exact.push((at as u64, *h));
            }
        }
        let cut = self.cut(sample);
        let packer = self.packer();
        let pack = |of| {
            let mut chunk = cut.gather(of, &q);
            self.difference(&mut chunk, of.1);
            packer.pack(&chunk)
        };
        let chunks = cut.chunks().map(pack).collect::<Result<_>>()?;
        Ok((chunks, exact))
    }

    pub fn decode(&self, chunks: &[Vec<u8>], sample: &Sample, target: &mut [f32]) -> Result<()> {
        let cut = self.cut(sample);
        let packer = self.packer();
        let mut values = Vec::new();
        for (of, bytes) in cut.chunks().zip(chunks) {
            let mut chunk = packer.unpack(bytes, of.1.iter().product())?;
            self.sum(&mut chunk, of.1);
            values.clear();
            values.extend(chunk.iter().map(|q| self.value(*q, sample.scale)));
            cut.scatter(of, &values, target);
        }
        Ok(())
    }

    fn packer(&self) -> Packer {
        match &self.pack {
            Pack::Zarr(codecs) => Packer::Zarr(Chain::new(codecs, 2)),
            Pack::Pco => Packer::Pco,
        }
    }

    /// Returns the distance between a value and its neighbour, and whether a value has one.
    fn neighbour(
        &self,
        [_, columns, bins]: [usize; 3],
        pixels: usize,
    ) -> (usize, impl Fn(usize) -> bool) {
        let (predict, first) = (self.predict, self.bins_first);
        let step = match (predict, first) {
            (Predict::Time, false) | (Predict::Column, true) => 1,
            (Predict::Time, true) => pixels,
            (Predict::Column, false) => bins,
            (Predict::No, _) => 0,
        };
        let has = move |at: usize| {
            let (pixel, bin) = if first {
                (at % pixels, at / pixels)
            } else {
                (at / bins, at % bins)
            };
            match predict {
                Predict::No => false,
                Predict::Time => bin > 0,
                Predict::Column => pixel % columns > 0,
            }
        };
        (step, has)
    }

    /// Replaces values by differences from their predictions, mapped so that small differences of
    /// either sign become small numbers.
    fn difference(&self, chunk: &mut [u16], size: [usize; 3]) {
        if self.predict == Predict::No {
            return;
        }
        let (step, has) = self.neighbour(size, size[0] * size[1]);
        for at in (0..chunk.len()).rev() {
            let before = if has(at) { chunk[at - step] } else { 0 };
            let d = chunk[at].wrapping_sub(before) as i16;
            chunk[at] = ((d << 1) ^ (d >> 15)) as u16;
        }
    }

    fn sum(&self, chunk: &mut [u16], size: [usize; 3]) {
        if self.predict == Predict::No {
            return;
        }
        let (step, has) = self.neighbour(size, size[0] * size[1]);
        for at in 0..chunk.len() {
            let z = chunk[at];
            let d = (z >> 1) ^ (z & 1).wrapping_neg();
            let before = if has(at) { chunk[at - step] } else { 0 };
            chunk[at] = before.wrapping_add(d);
        }
    }
}

enum Packer {
    Zarr(Chain),
    Pco,
}

impl Packer {
    fn pack(&self, chunk: &[u16]) -> Result<Vec<u8>> {
        match self {
            Self::Zarr(chain) => chain.encode(bytemuck::cast_slice(chunk)),
            Self::Pco => pco::standalone::simple_compress(chunk, &pco::ChunkConfig::default())
                .map_err(broken),
        }
    }

    fn unpack(&self, bytes: &[u8], values: usize) -> Result<Vec<u16>> {
        match self {
            Self::Zarr(chain) => Ok(bytemuck::pod_collect_to_vec(&chain.decode(bytes, values)?)),
            Self::Pco => pco::standalone::simple_decompress(bytes).map_err(broken),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_candidate_gives_back_the_codes_it_was_given() {
        let (height, width, bins) = (5, 40, 150);
        let h = (0..height * width * bins).map(|i| ((i * 7919) % 1013) as f32 * 0.37);
        let mut sample = Sample::plain(height, width, bins, h.collect(), 2.0);
        sample.h[77] = 1e12;
        for (name, variant) in Variant::all() {
            let (chunks, exact) = variant.encode(&sample).unwrap();
            assert_eq!(exact, [(77, 1e12)], "{name}");
            let mut back = vec![f32::NAN; sample.h.len()];
            variant.decode(&chunks, &sample, &mut back).unwrap();
            for (at, (found, h)) in back.iter().zip(&sample.h).enumerate() {
                let expected = variant.value(variant.code(*h, 2.0), 2.0);
                assert_eq!(*found, expected, "{name} at {at}");
            }
        }
    }
}
