//! Reads parts of a transient. Only the inner chunks that overlap the part are fetched and decoded.

use std::ops::Range;

use bytes::Bytes;
use rayon::prelude::*;

use crate::coding::shard;
use crate::coding::tiles::{Part, Tiles};
use crate::coding::values::Decoder;
use crate::layout::manifest::Manifest;
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::{ArrayCodec, Dataset};
use picofarm_store::StorageError;
use picofarm_store::objects::Rereads;

/// Inner chunks with a gap of at most this many bytes are fetched in one request, including the
/// gap.
const GAP: u64 = 16 * 1024;

impl Dataset {
    /// Reads a part of an array.
    pub(crate) async fn read_part(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        part: Part,
    ) -> Result<Vec<f32>, StorageError> {
        let mut rereads = Rereads::new(&*self.store);
        loop {
            let read = self.read_part_once(manifest, array, &part).await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    async fn read_part_once(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        part: &Part,
    ) -> Result<Vec<f32>, StorageError> {
        let tiles = Tiles::new(&self.spec, &array.layout);
        let wanted = tiles.touching(part);
        let chunks = self.fetch_tiles(manifest, array, &tiles, &wanted).await?;
        let mut target = vec![0f32; part.len()];
        let decoding = self.decoding(manifest, array);
        let complete = decoding.part(&tiles, chunks, part, &mut target);
        let key = array.layout.key(manifest.scene);
        let complete = complete.map_err(|e| self.damaged(e, manifest, &key))?;
        self.complete(manifest, complete)?;
        Ok(target)
    }

    /// Reads a part of an array into `target`, one image per bin.
    pub(crate) async fn read_part_planes(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        part: &Part,
        target: &mut [f32],
    ) -> Result<(), StorageError> {
        let key = array.layout.key(manifest.scene);
        let tiles = Tiles::new(&self.spec, &array.layout);
        let decoding = self.decoding(manifest, array);
        let decoded = if *part == tiles.whole() {
            let bytes = self.object(manifest, &key).await?;
            decoding.planes(&bytes, target)
        } else {
            let wanted = tiles.touching(part);
            let chunks = self.fetch_tiles(manifest, array, &tiles, &wanted).await?;
            decoding.part_planes(&tiles, &chunks, part, target)
        };
        let complete = decoded.map_err(|e| self.damaged(e, manifest, &key))?;
        self.complete(manifest, complete)
    }

    /// Fetches the encoded bytes of the wanted tiles; `None` = all fill value.
    async fn fetch_tiles(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        tiles: &Tiles,
        wanted: &[usize],
    ) -> Result<Vec<(usize, Option<Bytes>)>, StorageError> {
        let key = array.layout.key(manifest.scene);
        let path = self.path(&key);
        let damaged = |what: String| StorageError::Damaged {
            object: self.shown(&path),
            what,
        };
        let entry = manifest
            .object(&key)
            .ok_or_else(|| damaged("the manifest does not list it".into()))?;
        let tail = shard::index_len(tiles.count()) as u64;
        let Some(start) = entry.size.checked_sub(tail) else {
            return Err(damaged(format!(
                "{} bytes are too few for a shard",
                entry.size
            )));
        };
        let fetch_error = |e| match e {
            object_store::Error::NotFound { .. } => damaged("the object is missing".into()),
            e => StorageError::store("read", self.shown(&path), e),
        };
        let index = self.object_range(entry, &path, start..entry.size);
        let index = index.await.map_err(fetch_error)?;
        let index = shard::parse_index(&index, tiles.count(), entry.size)
            .map_err(|e| self.damaged(e, manifest, &key))?;
        let ranges: Vec<(usize, Range<u64>)> = wanted
            .iter()
            .filter_map(|tile| {
                index[tiles.place(*tile)]
                    .clone()
                    .map(|range| (*tile, range))
            })
            .collect();
        let only: Vec<Range<u64>> = ranges.iter().map(|(_, r)| r.clone()).collect();
        // The store's default would fetch gaps of up to a megabyte.
        let fetch = |range| self.object_range(entry, &path, range);
        let parts = object_store::coalesce_ranges(&only, fetch, GAP);
        let parts = parts.await.map_err(fetch_error)?;
        let mut found = ranges.iter().map(|(tile, _)| *tile).zip(parts).peekable();
        Ok(wanted
            .iter()
            .map(|tile| {
                (
                    *tile,
                    found.next_if(|(t, _)| t == tile).map(|(_, bytes)| bytes),
                )
            })
            .collect())
    }

    /// Decodes h of a whole scene from the bytes of its shard.
    pub(crate) fn decode_shard(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        bytes: &Bytes,
    ) -> Result<Vec<f32>, StorageError> {
        let len = array.layout.planes() * self.spec.transient_len();
        let mut target = vec![0f32; len];
        self.decode_shard_into(manifest, array, bytes, &mut target)?;
        Ok(target)
    }

    /// Like [`Self::decode_shard`], but overwrites a target of that size.
    pub(crate) fn decode_shard_into(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        bytes: &Bytes,
        target: &mut [f32],
    ) -> Result<(), StorageError> {
        let decoding = self.decoding(manifest, array);
        let whole = decoding.shard(bytes, target)?;
        self.complete(manifest, whole)
    }

    /// Like [`Self::decode_shard_into`], but as one image per bin: `[bin][row][column]`.
    pub(crate) fn decode_planes_into(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        bytes: &Bytes,
        target: &mut [f32],
    ) -> Result<(), StorageError> {
        let whole = self.decoding(manifest, array).planes(bytes, target)?;
        self.complete(manifest, whole)
    }

    /// Like [`Self::decode_planes_into`], but copies the codes of the square-root profile.
    pub(crate) fn copy_codes_into(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        bytes: &Bytes,
        target: &mut [u16],
    ) -> Result<(), StorageError> {
        self.decoding(manifest, array).codes(bytes, target)
    }

    /// Returns whether a shard can be decoded, whatever its values are.
    pub(crate) fn shard_is_whole(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        bytes: &Bytes,
    ) -> bool {
        let len = array.layout.planes() * self.spec.transient_len();
        let decoding = self.decoding(manifest, array);
        decoding.shard(bytes, &mut vec![0f32; len]).is_ok()
    }

    fn decoding<'a>(&'a self, manifest: &'a Manifest, array: &'a ArrayCodec) -> Decoding<'a> {
        Decoding {
            spec: &self.spec,
            array,
            scale: manifest.scale,
            overflow: manifest.overflow_of(array.layout.quantity),
        }
    }

    fn complete(&self, manifest: &Manifest, complete: Complete) -> Result<(), StorageError> {
        if complete.0 {
            return Ok(());
        }
        Err(StorageError::Damaged {
            object: self.shown(&self.path(&Manifest::key(manifest.scene))),
            what: "a saturated bin has no exact value in the overflow list".into(),
        })
    }
}

/// Whether the exact value of each saturated bin is known.
#[must_use]
pub(crate) struct Complete(pub bool);

/// The context for decoding a transient.
pub(crate) struct Decoding<'a> {
    pub spec: &'a DatasetSpec,
    pub array: &'a ArrayCodec,
    pub scale: f32,
    pub overflow: &'a [(u64, f32)],
}

impl Decoding<'_> {
    /// Decodes a whole transient from the bytes of its shard, overwriting a target of its size.
    pub fn shard(&self, bytes: &Bytes, target: &mut [f32]) -> Result<Complete, StorageError> {
        let tiles = Tiles::new(self.spec, &self.array.layout);
        let chunks = Self::chunks(&tiles, bytes)?;
        if chunks.iter().any(Option::is_none) {
            target.fill(0.0);
        }
        let chunks = chunks.into_iter().enumerate().collect();
        self.part(&tiles, chunks, &tiles.whole(), target)
    }

    /// Like [`Self::shard`], but as one image per bin.
    pub fn planes(&self, bytes: &Bytes, target: &mut [f32]) -> Result<Complete, StorageError> {
        let tiles = Tiles::new(self.spec, &self.array.layout);
        let chunks = Self::numbered(&tiles, bytes)?;
        self.part_planes(&tiles, &chunks, &tiles.whole(), target)
    }

    /// Copies the codes of a whole transient of the square-root profile, as one image per bin.
    pub fn codes(&self, bytes: &Bytes, target: &mut [u16]) -> Result<(), StorageError> {
        let tiles = Tiles::new(self.spec, &self.array.layout);
        let chunks = Self::numbered(&tiles, bytes)?;
        let copy = |decoder: &Decoder<'_>, tile, raw: &[u8], part: &Part, codes: &mut [u16]| {
            decoder.copy_planes(tile, raw, part, codes);
            false
        };
        self.slabs(&tiles, &chunks, &tiles.whole(), target, copy)?;
        Ok(())
    }

    /// Decodes tiles into a part's values, one image per bin, and applies the overflow list.
    fn part_planes(
        &self,
        tiles: &Tiles,
        chunks: &[(usize, Option<Bytes>)],
        part: &Part,
        target: &mut [f32],
    ) -> Result<Complete, StorageError> {
        let decode = |decoder: &Decoder<'_>, tile, raw: &[u8], part: &Part, h: &mut [f32]| {
            decoder.decode_planes(tile, raw, part, h)
        };
        let saturated = self.slabs(tiles, chunks, part, target, decode)?;
        let area = part.rows.len() * part.columns.len();
        for (index, value) in self.overflow {
            if let Some([row, column, bin]) = tiles.within(*index, part) {
                target[bin * area + row * part.columns.len() + column] = *value;
            }
        }
        let complete = !saturated || target.iter().all(|h| h.is_finite());
        Ok(Complete(complete))
    }

    /// Calls `each` with the raw bytes of each tile, those bins of the part that it has, and their
    /// images in `target`. Tiles with the same bins write to adjacent memory, so one thread decodes
    /// them; different ranges of bins are decoded in parallel. A tile without bytes is all zero.
    /// Returns whether `each` returned true.
    fn slabs<T: bytemuck::Pod + Send>(
        &self,
        tiles: &Tiles,
        chunks: &[(usize, Option<Bytes>)],
        part: &Part,
        target: &mut [T],
        each: impl Fn(&Decoder<'_>, usize, &[u8], &Part, &mut [T]) -> bool + Sync,
    ) -> Result<bool, StorageError> {
        if chunks.iter().any(|(_, bytes)| bytes.is_none()) {
            target.fill(T::zeroed());
        }
        let area = part.rows.len() * part.columns.len();
        let mut slabs = Vec::new();
        let mut rest = target;
        let mut first = part.bins.start;
        while first < part.bins.end {
            let slab = first / tiles.slab_len();
            let end = ((slab + 1) * tiles.slab_len()).min(part.bins.end);
            let (values, after) = std::mem::take(&mut rest).split_at_mut((end - first) * area);
            let bins = Part {
                bins: first..end,
                ..part.clone()
            };
            slabs.push((slab, bins, values));
            rest = after;
            first = end;
        }
        let found = slabs
            .into_par_iter()
            .map(|(slab, part, values)| {
                let decoder = Decoder::new(self.spec.profile, self.scale, tiles);
                let mut found = false;
                let own = chunks
                    .iter()
                    .filter(|(tile, _)| tiles.slab_of(*tile) == slab);
                for (tile, bytes) in own {
                    let Some(bytes) = bytes else { continue };
                    let raw = self.array.codec.decode(bytes)?;
                    found |= each(&decoder, *tile, &raw, &part, values);
                }
                Ok(found)
            })
            .collect::<Result<Vec<bool>, StorageError>>()?;
        Ok(found.contains(&true))
    }

    /// Returns the encoded bytes of each tile of a shard, with its number.
    fn numbered(tiles: &Tiles, bytes: &Bytes) -> Result<Vec<(usize, Option<Bytes>)>, StorageError> {
        Ok(Self::chunks(tiles, bytes)?
            .into_iter()
            .enumerate()
            .collect())
    }

    /// Returns the encoded bytes of each tile of a shard; `None` = all fill value.
    fn chunks(tiles: &Tiles, bytes: &Bytes) -> Result<Vec<Option<Bytes>>, StorageError> {
        let Some(start) = bytes.len().checked_sub(shard::index_len(tiles.count())) else {
            let what = format!("{} bytes are too few", bytes.len());
            return Err(StorageError::codec("cannot read a shard's index", what));
        };
        let index = shard::parse_index(&bytes[start..], tiles.count(), bytes.len() as u64)?;
        let bytes_of = |r: &Range<u64>| bytes.slice(r.start as usize..r.end as usize);
        let of_tile = |tile| index[tiles.place(tile)].as_ref().map(bytes_of);
        Ok((0..tiles.count()).map(of_tile).collect())
    }

    /// Decodes tiles into a part's values and applies the overflow list. Bands of tiles are decoded
    /// in parallel, each directly into its rows. A tile without bytes is all fill value, which the
    /// target already contains.
    fn part(
        &self,
        tiles: &Tiles,
        chunks: Vec<(usize, Option<Bytes>)>,
        part: &Part,
        target: &mut [f32],
    ) -> Result<Complete, StorageError> {
        let mut bands = Vec::new();
        let mut rest = &mut *target;
        let mut top = part.rows.start;
        for chunks in chunks.chunk_by(|a, b| tiles.row_of(a.0) == tiles.row_of(b.0)) {
            let end = tiles.rows_of(chunks[0].0).end.min(part.rows.end);
            let len = (end - top) * part.row_len();
            let (values, below) = std::mem::take(&mut rest).split_at_mut(len);
            let rows = Part {
                rows: top..end,
                ..part.clone()
            };
            bands.push((chunks, rows, values));
            rest = below;
            top = end;
        }
        let saturated = bands
            .into_par_iter()
            .map(|(chunks, rows, values)| {
                let mut decoder = Decoder::new(self.spec.profile, self.scale, tiles);
                let mut saturated = false;
                for (tile, bytes) in chunks {
                    let Some(bytes) = bytes else { continue };
                    let raw = self.array.codec.decode(bytes)?;
                    saturated |= decoder.decode(*tile, &raw, &rows, values);
                }
                Ok(saturated)
            })
            .collect::<Result<Vec<bool>, StorageError>>()?;
        for (index, value) in self.overflow {
            if let Some([row, column, bin]) = tiles.within(*index, part) {
                target[row * part.row_len() + column * part.bins.len() + bin] = *value;
            }
        }
        let complete = !saturated.contains(&true) || target.iter().all(|h| h.is_finite());
        Ok(Complete(complete))
    }
}
