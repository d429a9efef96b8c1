//! Reads parts of a transient. Only the inner chunks that overlap the part are fetched and decoded.

use std::ops::Range;

use bytes::Bytes;
use object_store::ObjectStoreExt;
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
        let wanted: Vec<usize> = (0..tiles.count())
            .filter(|tile| tiles.touches(*tile, part))
            .collect();
        let chunks = self.fetch_tiles(manifest, array, &tiles, &wanted).await?;
        let mut target = vec![0f32; part.len()];
        let decoding = self.decoding(manifest, array);
        let complete = decoding.part(&tiles, chunks, part, &mut target);
        let path = self.path(&array.layout.key(manifest.scene));
        let complete = complete.map_err(|e| e.in_object(|| self.shown(&path)))?;
        self.complete(manifest, complete)?;
        Ok(target)
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
        let index = self.store.get_range(&path, start..entry.size);
        let index = index.await.map_err(fetch_error)?;
        let index = shard::parse_index(&index, tiles.count(), entry.size)
            .map_err(|e| e.in_object(|| self.shown(&path)))?;
        let ranges: Vec<(usize, Range<u64>)> = wanted
            .iter()
            .filter_map(|tile| index[*tile].clone().map(|range| (*tile, range)))
            .collect();
        let only: Vec<Range<u64>> = ranges.iter().map(|(_, r)| r.clone()).collect();
        // The store's default would fetch gaps of up to a megabyte.
        let fetch = |range| self.store.get_range(&path, range);
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

    /// Like [`Self::shard`], but as one image per bin. Tiles with the same bins write to adjacent
    /// memory, so one thread decodes them; different ranges of bins are decoded in parallel.
    pub fn planes(&self, bytes: &Bytes, target: &mut [f32]) -> Result<Complete, StorageError> {
        let pixels = self.spec.pixels();
        let saturated = self.slabs(bytes, target, 0.0, |decoder, tile, raw, values| {
            decoder.decode_planes(tile, raw, pixels, values)
        })?;
        let bins = self.spec.gate.bins as usize;
        for (index, value) in self.overflow {
            let (pixel, bin) = (*index as usize / bins, *index as usize % bins);
            if pixel < pixels {
                target[bin * pixels + pixel] = *value;
            }
        }
        let complete = !saturated || target.iter().all(|h| h.is_finite());
        Ok(Complete(complete))
    }

    /// Like [`Self::planes`], but copies the codes of the square-root profile.
    pub fn codes(&self, bytes: &Bytes, target: &mut [u16]) -> Result<(), StorageError> {
        let pixels = self.spec.pixels();
        self.slabs(bytes, target, 0, |decoder, tile, raw, codes| {
            decoder.copy_planes(tile, raw, pixels, codes);
            false
        })?;
        Ok(())
    }

    /// Calls `each` with the raw bytes of each tile and the images of its bins in `target`. `fill`
    /// is the value of tiles without bytes. Returns whether `each` returned true.
    fn slabs<T: Copy + Send + Sync>(
        &self,
        bytes: &Bytes,
        target: &mut [T],
        fill: T,
        each: impl Fn(&mut Decoder<'_>, usize, &[u8], &mut [T]) -> bool + Sync,
    ) -> Result<bool, StorageError> {
        let tiles = Tiles::new(self.spec, &self.array.layout);
        let chunks = Self::chunks(&tiles, bytes)?;
        if chunks.iter().any(Option::is_none) {
            target.fill(fill);
        }
        let slabs = target
            .par_chunks_mut(tiles.slab_len() * self.spec.pixels())
            .enumerate();
        let found = slabs
            .map(|(slab, values)| {
                let mut decoder = Decoder::new(self.spec.profile, self.scale, &tiles);
                let mut found = false;
                for tile in tiles.of_slab(slab) {
                    let Some(bytes) = &chunks[tile] else { continue };
                    let raw = self.array.codec.decode(bytes)?;
                    found |= each(&mut decoder, tile, &raw, values);
                }
                Ok(found)
            })
            .collect::<Result<Vec<bool>, StorageError>>()?;
        Ok(found.contains(&true))
    }

    /// Returns the encoded bytes of each tile of a shard; `None` = all fill value.
    fn chunks(tiles: &Tiles, bytes: &Bytes) -> Result<Vec<Option<Bytes>>, StorageError> {
        let Some(start) = bytes.len().checked_sub(shard::index_len(tiles.count())) else {
            let what = format!("{} bytes are too few", bytes.len());
            return Err(StorageError::codec("cannot read a shard's index", what));
        };
        let index = shard::parse_index(&bytes[start..], tiles.count(), bytes.len() as u64)?;
        let bytes_of = |r: Range<u64>| bytes.slice(r.start as usize..r.end as usize);
        Ok(index.into_iter().map(|entry| entry.map(bytes_of)).collect())
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
        let bins = self.spec.gate.bins as usize;
        let width = self.spec.width as usize;
        for (index, value) in self.overflow {
            let (pixel, bin) = (*index as usize / bins, *index as usize % bins);
            let (row, column) = (pixel / width, pixel % width);
            if part.rows.contains(&row)
                && part.columns.contains(&column)
                && part.bins.contains(&bin)
            {
                let at = (row - part.rows.start) * part.columns.len() + column - part.columns.start;
                target[at * part.bins.len() + bin - part.bins.start] = *value;
            }
        }
        let complete = !saturated.contains(&true) || target.iter().all(|h| h.is_finite());
        Ok(Complete(complete))
    }
}
