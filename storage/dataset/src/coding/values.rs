//! Converts values of h to a tile's stored values and back, by profile.

use std::borrow::Cow;
use std::ops::Range;

use crate::coding::counts;
use crate::coding::rounding::Rounding;
use crate::coding::squareroot::{ErrorSums, SATURATED, SquareRoot};
use crate::coding::tiles::{Part, Run, Tiles};
use crate::layout::spec::Profile;
use picofarm_store::StorageError;

/// The values of a transient: its planes one after the other.
pub(crate) struct Source<'a> {
    pub name: &'a str,
    pub planes: &'a [&'a [f32]],
    /// Number of pixels in a plane, and of bins in a pixel.
    pub pixels: usize,
    pub bins: usize,
    pub scale: f32,
}

impl Source<'_> {
    fn at(&self, pixel: usize, bins: &Range<usize>) -> &[f32] {
        let plane = self.planes[pixel / self.pixels];
        &plane[pixel % self.pixels * self.bins..][bins.clone()]
    }
}

/// A tile's values in stored order, and the encoding losses.
pub(crate) struct CodedValues {
    pub bytes: Vec<u8>,
    pub error: ErrorSums,
    /// Saturated bins: (flat index, exact value), unordered.
    pub overflow: Vec<(u64, f32)>,
}

/// Encodes a tile.
///
/// # Errors
/// [`StorageError::Invalid`] names a value that the profile cannot represent.
pub(crate) fn code(
    profile: Profile,
    tiles: &Tiles,
    tile: usize,
    source: &Source<'_>,
) -> Result<CodedValues, StorageError> {
    let mut error = ErrorSums::default();
    let mut overflow = Vec::new();
    let valid = |h: &[f32], at: usize| match h.iter().all(|h| (0.0..=f32::MAX).contains(h)) {
        true => Ok(()),
        false => Err(invalid_value(source.name, h, at)),
    };
    let bytes = match profile {
        Profile::SqrtU16 { delta } => {
            let code = SquareRoot::new(delta, source.scale);
            let q = each(tiles, tile, source, |h, q: &mut [u16], at| {
                let facts = code.encode_run(h, q, &mut error);
                if facts.invalid {
                    return Err(invalid_value(source.name, h, at));
                }
                if facts.saturated {
                    overflow.extend(saturated(h, q, at));
                }
                Ok(())
            })?;
            bytemuck::cast_slice(&tiles.to_stored(q)).to_vec()
        }
        Profile::CountsU16 => {
            let q = each(tiles, tile, source, |h, q: &mut [u16], at| {
                match counts::encode_run(source.scale, h, q, &mut error) {
                    Ok(false) => {}
                    Ok(true) => overflow.extend(saturated(h, q, at)),
                    Err(bad) => return Err(invalid_count(source, h[bad], at + bad)),
                }
                Ok(())
            })?;
            bytemuck::cast_slice(&tiles.to_stored(q)).to_vec()
        }
        Profile::PlainF32 { round } => {
            let rounding = (round > 0.0).then(|| Rounding::new(round, source.scale));
            let values = each(tiles, tile, source, |h, to: &mut [f32], at| {
                valid(h, at)?;
                match rounding {
                    Some(rounding) => rounding.run(h, to, &mut error),
                    None => {
                        to.copy_from_slice(h);
                        error.add_exact(h.len());
                    }
                }
                Ok(())
            })?;
            bytemuck::cast_slice(&tiles.to_stored(values)).to_vec()
        }
    };
    Ok(CodedValues {
        bytes,
        error,
        overflow,
    })
}

/// Encodes a tile's values, histogram by histogram. `code` is called with each histogram's bins,
/// their target, and the flat index of the first bin.
fn each<T: bytemuck::Pod>(
    tiles: &Tiles,
    tile: usize,
    source: &Source<'_>,
    mut code: impl FnMut(&[f32], &mut [T], usize) -> Result<(), StorageError>,
) -> Result<Vec<T>, StorageError> {
    let mut values = vec![T::zeroed(); tiles.tile_len()];
    let bins = tiles.bins_of(tile);
    for run in tiles.runs(tile) {
        for k in 0..run.columns {
            let (pixel, to) = (run.pixel + k, (run.tile + k) * tiles.slab_len());
            let to = &mut values[to..to + bins.len()];
            code(
                source.at(pixel, &bins),
                to,
                pixel * source.bins + bins.start,
            )?;
        }
    }
    Ok(values)
}

fn saturated<'a>(
    h: &'a [f32],
    q: &'a [u16],
    at: usize,
) -> impl Iterator<Item = (u64, f32)> + use<'a> {
    let all = h.iter().zip(q).enumerate();
    all.filter(|(_, (_, q))| **q == SATURATED)
        .map(move |(i, (h, _))| ((at + i) as u64, *h))
}

fn invalid_value(name: &str, h: &[f32], start: usize) -> StorageError {
    let at = h
        .iter()
        .position(|h| !(0.0..=f32::MAX).contains(h))
        .unwrap_or(0);
    StorageError::invalid(
        format!("record.{name}[{}]", start + at),
        format!("expected a finite value of at least 0, found {}", h[at]),
    )
}

fn invalid_count(source: &Source<'_>, h: f32, at: usize) -> StorageError {
    if !(0.0..=f32::MAX).contains(&h) {
        return invalid_value(source.name, &[h], at);
    }
    StorageError::invalid(
        format!("record.{}[{at}]", source.name),
        format!(
            "expected a whole number of photons, found {}; counts-u16 holds counts, other values need sqrt-u16 or lossless",
            h * source.scale
        ),
    )
}

/// Decodes a tile's stored values into a part's values. Saturated bins become +∞.
pub(crate) struct Decoder<'a> {
    profile: Profile,
    scale: f32,
    tiles: &'a Tiles,
    codes: Vec<u16>,
    floats: Vec<f32>,
}

impl<'a> Decoder<'a> {
    pub fn new(profile: Profile, scale: f32, tiles: &'a Tiles) -> Self {
        Self {
            profile,
            scale,
            tiles,
            codes: Vec::new(),
            floats: Vec::new(),
        }
    }

    /// Decodes those values of `tile` that are in `part` into `target`, the part's values. `raw`
    /// are the tile's stored bytes. Returns whether one of them is saturated.
    pub fn decode(&mut self, tile: usize, raw: &[u8], part: &Part, target: &mut [f32]) -> bool {
        match self.profile {
            Profile::SqrtU16 { delta } => {
                let code = SquareRoot::new(delta, self.scale);
                let mut codes = std::mem::take(&mut self.codes);
                let saturated = self.runs(tile, &values(raw), &mut codes, part, target, |q, h| {
                    code.decode_run(q, h)
                });
                self.codes = codes;
                saturated
            }
            Profile::CountsU16 => {
                let scale = self.scale;
                let mut codes = std::mem::take(&mut self.codes);
                let saturated = self.runs(tile, &values(raw), &mut codes, part, target, |q, h| {
                    counts::decode_run(scale, q, h)
                });
                self.codes = codes;
                saturated
            }
            Profile::PlainF32 { .. } => {
                let mut floats = std::mem::take(&mut self.floats);
                self.runs(tile, &values(raw), &mut floats, part, target, |from, h| {
                    h.copy_from_slice(from);
                    false
                });
                self.floats = floats;
                false
            }
        }
    }

    /// Like [`Self::decode`], but decodes into images of `pixels` pixels, one for each of the
    /// tile's bins, all in `target`.
    pub fn decode_planes(
        &mut self,
        tile: usize,
        raw: &[u8],
        pixels: usize,
        target: &mut [f32],
    ) -> bool {
        match self.profile {
            Profile::SqrtU16 { delta } => {
                let code = SquareRoot::new(delta, self.scale);
                let mut codes = std::mem::take(&mut self.codes);
                let decode = |q: &[u16], h: &mut [f32]| code.decode_run(q, h);
                let saturated = self.planes(tile, &values(raw), &mut codes, pixels, target, decode);
                self.codes = codes;
                saturated
            }
            Profile::CountsU16 => {
                let scale = self.scale;
                let mut codes = std::mem::take(&mut self.codes);
                let decode = |q: &[u16], h: &mut [f32]| counts::decode_run(scale, q, h);
                let saturated = self.planes(tile, &values(raw), &mut codes, pixels, target, decode);
                self.codes = codes;
                saturated
            }
            Profile::PlainF32 { .. } => {
                let mut floats = std::mem::take(&mut self.floats);
                let copy = |from: &[f32], h: &mut [f32]| {
                    h.copy_from_slice(from);
                    false
                };
                self.planes(tile, &values(raw), &mut floats, pixels, target, copy);
                self.floats = floats;
                false
            }
        }
    }

    /// Like [`Self::decode_planes`], but copies the codes of [`Profile::SqrtU16`]. Saturated bins
    /// keep theirs.
    pub fn copy_planes(&mut self, tile: usize, raw: &[u8], pixels: usize, target: &mut [u16]) {
        let mut codes = std::mem::take(&mut self.codes);
        let copy = |from: &[u16], to: &mut [u16]| {
            to.copy_from_slice(from);
            false
        };
        self.planes(tile, &values(raw), &mut codes, pixels, target, copy);
        self.codes = codes;
    }

    fn planes<T: bytemuck::Pod, U>(
        &self,
        tile: usize,
        stored: &[T],
        scratch: &mut Vec<T>,
        pixels: usize,
        target: &mut [U],
        decode: impl Fn(&[T], &mut [U]) -> bool,
    ) -> bool {
        let mut saturated = false;
        let runs: Vec<Run> = self.tiles.runs(tile).collect();
        for (bin, plane) in target.chunks_exact_mut(pixels).enumerate() {
            for run in &runs {
                let from = self.tiles.of_bin(stored, run, bin, scratch);
                saturated |= decode(from, &mut plane[run.pixel..run.pixel + run.columns]);
            }
        }
        saturated
    }

    fn runs<T: bytemuck::Pod>(
        &self,
        tile: usize,
        stored: &[T],
        scratch: &mut Vec<T>,
        part: &Part,
        target: &mut [f32],
        decode: impl Fn(&[T], &mut [f32]) -> bool,
    ) -> bool {
        let bins = self.tiles.bins_of(tile);
        let bins = bins.start.max(part.bins.start)..bins.end.min(part.bins.end);
        let mut saturated = false;
        for run in self.tiles.runs(tile).filter(|r| part.rows.contains(&r.row)) {
            let columns = columns(&run, part);
            self.tiles
                .of_run(stored, &run, columns.clone(), bins.clone(), scratch);
            let top = (run.row - part.rows.start) * part.row_len();
            let histograms = scratch.chunks_exact(bins.len());
            for (column, from) in columns.zip(histograms) {
                let at = top + (column - part.columns.start) * part.bins.len() + bins.start
                    - part.bins.start;
                saturated |= decode(from, &mut target[at..at + bins.len()]);
            }
        }
        saturated
    }
}

/// Returns the columns of a run inside the part.
fn columns(run: &Run, part: &Part) -> Range<usize> {
    run.column.max(part.columns.start)..(run.column + run.columns).min(part.columns.end)
}

/// Casts bytes to values, copying them only if they are not aligned.
fn values<T: bytemuck::Pod>(bytes: &[u8]) -> Cow<'_, [T]> {
    match bytemuck::try_cast_slice(bytes) {
        Ok(values) => Cow::Borrowed(values),
        Err(_) => Cow::Owned(bytemuck::pod_collect_to_vec(bytes)),
    }
}
