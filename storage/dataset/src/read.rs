//! Reading published scenes back.

use std::borrow::Cow;
use std::ops::Range;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::{ObjectStore, ObjectStoreExt};
use rayon::prelude::*;

use crate::counts;
use crate::dataset::{ArrayCodec, Dataset};
use crate::encode::Tiles;
use crate::error::DatasetError;
use crate::layout::{Element, Quantity};
use crate::manifest::Manifest;
use crate::objects;
use crate::record::{Intrinsics, Spot};
use crate::shard;
use crate::spec::Profile;
use crate::squareroot::SquareRoot;

/// A type in which an array may be stored.
pub trait Stored: bytemuck::Pod + sealed::Stored {}

mod sealed {
    pub trait Stored {
        const ELEMENT: crate::layout::Element;
    }
}

macro_rules! stored {
    ($($type:ty => $element:ident),*) => {$(
        impl sealed::Stored for $type {
            const ELEMENT: Element = Element::$element;
        }
        impl Stored for $type {}
    )*};
}
stored!(f32 => F32, u8 => U8, u16 => U16, i16 => I16, u32 => U32);

impl Dataset {
    /// The manifest of a published scene (its objects are not looked at; see [`Self::published`]).
    ///
    /// # Errors
    /// [`DatasetError::NotPublished`], [`DatasetError::Damaged`], [`DatasetError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<Manifest, DatasetError> {
        self.check_scene(scene)?;
        let path = self.path(&Manifest::key(scene));
        match objects::get(&*self.store, &path).await? {
            Some(bytes) => Manifest::parse(&bytes, scene, &self.shown(&path)),
            None => Err(DatasetError::NotPublished {
                scene,
                object: self.shown(&path),
            }),
        }
    }

    /// Indices of the published scenes, ascending.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, DatasetError> {
        let folder = self.path("manifests");
        let mut scenes: Vec<u64> = self
            .store
            .list(Some(&folder))
            .try_filter_map(|object| async move {
                let name = object
                    .location
                    .filename()
                    .and_then(|n| n.strip_suffix(".json"));
                Ok(name.and_then(|n| n.parse::<u64>().ok()))
            })
            .try_collect()
            .await
            .map_err(|e| DatasetError::store("list", self.shown(&folder), e))?;
        scenes.retain(|scene| *scene < self.spec.scenes);
        scenes.sort_unstable();
        Ok(scenes)
    }

    /// h of a scene, decoded, with the exact values of saturated bins: `[row][column][bin]`. Blocks its thread
    /// while decoding on rayon's threads.
    ///
    /// # Errors
    /// [`DatasetError::NotPublished`], [`DatasetError::Damaged`], [`DatasetError::Codec`], [`DatasetError::Store`].
    pub async fn read_transient(&self, scene: u64) -> Result<Vec<f32>, DatasetError> {
        self.read_histogram(scene, Quantity::Transient).await
    }

    /// h of a scene from any of the data set's transients: `[row][column][bin]`, for `TransientSpots`
    /// `[spot][row][column][bin]`. Blocks its thread while decoding on rayon's threads.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where the data set has no such transient; those of [`Self::read_transient`].
    pub async fn read_histogram(
        &self,
        scene: u64,
        quantity: Quantity,
    ) -> Result<Vec<f32>, DatasetError> {
        let array = self.array_of(quantity)?;
        if !quantity.is_transient() {
            let what = format!("{} is no transient; use read", quantity.name());
            return Err(DatasetError::invalid("quantity", what));
        }
        let manifest = self.manifest(scene).await?;
        let path = self.path(&array.layout.key(scene));
        let bytes = objects::require(&*self.store, &path).await?;
        self.decode_shard(&manifest, array, &bytes)
    }

    /// A window of h: `[row][column][bin]` for the given rows and columns. Fetches and decodes only the inner
    /// chunks it touches.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where the window is empty or leaves the image; those of [`Self::read_transient`].
    pub async fn read_transient_crop(
        &self,
        scene: u64,
        rows: Range<u32>,
        columns: Range<u32>,
    ) -> Result<Vec<f32>, DatasetError> {
        let limits = [
            ("rows", &rows, self.spec.height),
            ("columns", &columns, self.spec.width),
        ];
        for (field, range, limit) in limits {
            if range.is_empty() || range.end > limit {
                let what = format!(
                    "expected a window within 0..{limit} that is not empty, found {range:?}"
                );
                return Err(DatasetError::invalid(field, what));
            }
        }
        let window = [
            rows.start as usize..rows.end as usize,
            columns.start as usize..columns.end as usize,
        ];
        let manifest = self.manifest(scene).await?;
        self.read_window(&manifest, self.array(Quantity::Transient), window)
            .await
    }

    /// h of one spot alone, from `transient_spots`: `[row][column][bin]`. Fetches and decodes nothing of the other spots.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where the data set has no such transient or no such spot; those of
    /// [`Self::read_transient`].
    pub async fn read_spot(&self, scene: u64, spot: u32) -> Result<Vec<f32>, DatasetError> {
        let array = self.array_of(Quantity::TransientSpots)?;
        if spot >= self.spec.spots {
            let what = format!(
                "the data set has {} spots, counted from 0; found {spot}",
                self.spec.spots
            );
            return Err(DatasetError::invalid("spot", what));
        }
        let (height, width) = (self.spec.height as usize, self.spec.width as usize);
        let top = spot as usize * height;
        let manifest = self.manifest(scene).await?;
        self.read_window(&manifest, array, [top..top + height, 0..width])
            .await
    }

    /// A window of an array's rows, counted through all of its planes, and columns.
    async fn read_window(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        window: [Range<usize>; 2],
    ) -> Result<Vec<f32>, DatasetError> {
        let tiles = Tiles::new(&self.spec, &array.layout);
        let wanted: Vec<usize> = (0..tiles.count())
            .filter(|tile| tiles.touches(*tile, &window[0], &window[1]))
            .collect();
        let chunks = self.fetch_tiles(manifest, array, &tiles, &wanted).await?;
        self.decode_window(manifest, array, &tiles, chunks, window)
    }

    /// The coded bytes of the wanted tiles; `None` = all fill value.
    async fn fetch_tiles(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        tiles: &Tiles,
        wanted: &[usize],
    ) -> Result<Vec<(usize, Option<Bytes>)>, DatasetError> {
        let key = array.layout.key(manifest.scene);
        let path = self.path(&key);
        let damaged = |what: String| DatasetError::Damaged {
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
            e => DatasetError::store("read", self.shown(&path), e),
        };
        let index = self.store.get_range(&path, start..entry.size);
        let index = index.await.map_err(fetch_error)?;
        let index = shard::parse_index(&index, tiles.count(), entry.size)?;
        let ranges: Vec<(usize, Range<u64>)> = wanted
            .iter()
            .filter_map(|tile| index[*tile].clone().map(|range| (*tile, range)))
            .collect();
        let only: Vec<Range<u64>> = ranges.iter().map(|(_, r)| r.clone()).collect();
        let parts = self.store.get_ranges(&path, &only);
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

    /// h of a whole scene from the bytes of its shard.
    pub(crate) fn decode_shard(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        bytes: &Bytes,
    ) -> Result<Vec<f32>, DatasetError> {
        let tiles = Tiles::new(&self.spec, &array.layout);
        let Some(start) = bytes.len().checked_sub(shard::index_len(tiles.count())) else {
            let what = format!("{} bytes are too few", bytes.len());
            return Err(DatasetError::codec("cannot read a shard's index", what));
        };
        let index = shard::parse_index(&bytes[start..], tiles.count(), bytes.len() as u64)?;
        let chunks = index
            .into_iter()
            .map(|entry| entry.map(|r| bytes.slice(r.start as usize..r.end as usize)))
            .enumerate()
            .collect();
        let rows = array.layout.planes() * self.spec.height as usize;
        let image = [0..rows, 0..self.spec.width as usize];
        self.decode_window(manifest, array, &tiles, chunks, image)
    }

    /// Decodes tiles into a window and applies the overflow list. Bands of tiles are decoded at once, each straight
    /// into its rows of the window.
    fn decode_window(
        &self,
        manifest: &Manifest,
        array: &ArrayCodec,
        tiles: &Tiles,
        chunks: Vec<(usize, Option<Bytes>)>,
        [rows, columns]: [Range<usize>; 2],
    ) -> Result<Vec<f32>, DatasetError> {
        let bins = self.spec.gate.bins as usize;
        let row_len = columns.len() * bins;
        let mut window = vec![0f32; rows.len() * row_len];
        let mut bands = Vec::new();
        let mut rest = &mut window[..];
        let mut top = rows.start;
        for chunks in chunks.chunk_by(|a, b| tiles.row_of(a.0) == tiles.row_of(b.0)) {
            let band = tiles.rows_of(chunks[0].0);
            let height = band.end.min(rows.end) - top;
            let (target, below) = std::mem::take(&mut rest).split_at_mut(height * row_len);
            bands.push((chunks, top..top + height, target));
            rest = below;
            top += height;
        }
        let saturated = bands
            .into_par_iter()
            .map(|(chunks, rows, target)| {
                let window = Window {
                    rows,
                    columns: columns.clone(),
                    target,
                };
                self.decode_band(manifest.scale, (array, tiles), chunks, window)
            })
            .collect::<Result<Vec<bool>, DatasetError>>()?;
        for (index, value) in manifest.overflow_of(array.layout.quantity) {
            let (pixel, bin) = (*index as usize / bins, *index as usize % bins);
            let width = self.spec.width as usize;
            let (row, column) = (pixel / width, pixel % width);
            if rows.contains(&row) && columns.contains(&column) {
                let at = (row - rows.start) * columns.len() + column - columns.start;
                window[at * bins + bin] = *value;
            }
        }
        if saturated.contains(&true) && window.iter().any(|h| h.is_infinite()) {
            return Err(DatasetError::Damaged {
                object: self.shown(&self.path(&Manifest::key(manifest.scene))),
                what: "a saturated bin has no exact value in the overflow list".into(),
            });
        }
        Ok(window)
    }

    /// Decodes a row of tiles into its part of a window; says whether a bin is saturated.
    fn decode_band(
        &self,
        scale: f32,
        (array, tiles): (&ArrayCodec, &Tiles),
        chunks: &[(usize, Option<Bytes>)],
        window: Window<'_>,
    ) -> Result<bool, DatasetError> {
        let bins = self.spec.gate.bins as usize;
        let codec = &array.codec;
        let mut saturated = false;
        for (tile, bytes) in chunks {
            // Without bytes the tile is all fill value, which the window holds already.
            let Some(bytes) = bytes else { continue };
            let raw = codec.decode(bytes)?;
            for run in tiles
                .runs(*tile)
                .filter(|run| window.rows.contains(&run.row))
            {
                let from = run.column.max(window.columns.start);
                let to = (run.column + run.columns).min(window.columns.end);
                let len = (to - from) * bins;
                let source = run.tile + (from - run.column) * bins;
                let pixel = (run.row - window.rows.start) * window.columns.len() + from
                    - window.columns.start;
                let target = &mut window.target[pixel * bins..][..len];
                match self.spec.profile {
                    Profile::SqrtU16 { delta } => {
                        let q = values::<u16>(&raw[source * 2..][..len * 2]);
                        saturated |= SquareRoot::new(delta, scale).decode_run(&q, target);
                    }
                    Profile::CountsU16 => {
                        let q = values::<u16>(&raw[source * 2..][..len * 2]);
                        saturated |= counts::decode_run(scale, &q, target);
                    }
                    Profile::PlainF32 => {
                        target.copy_from_slice(&values::<f32>(&raw[source * 4..][..len * 4]));
                    }
                }
            }
        }
        Ok(saturated)
    }

    /// The stored values of a quantity that is no transient, in the shape [`Quantity`] states.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where `T` is not the stored type or a transient is asked for;
    /// [`DatasetError::NotPublished`], [`DatasetError::Damaged`], [`DatasetError::Codec`], [`DatasetError::Store`].
    pub async fn read<T: Stored>(
        &self,
        scene: u64,
        quantity: Quantity,
    ) -> Result<Vec<T>, DatasetError> {
        let array = self.array_of(quantity)?;
        if quantity.is_transient() {
            return Err(DatasetError::invalid(
                "quantity",
                "transients are read by read_transient and read_histogram",
            ));
        }
        if array.layout.element != T::ELEMENT {
            let what = format!(
                "{} is stored as {}, not {}",
                quantity.name(),
                array.layout.element.name(),
                T::ELEMENT.name()
            );
            return Err(DatasetError::invalid("quantity", what));
        }
        let path = self.path(&array.layout.key(scene));
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            // Tells a scene that is not there from one that lost an object.
            self.manifest(scene).await?;
            return Err(DatasetError::Damaged {
                object: self.shown(&path),
                what: "the object is missing".into(),
            });
        };
        Ok(bytemuck::pod_collect_to_vec(&array.codec.decode(&bytes)?))
    }

    /// Unit normals, camera frame: `[row][column][3]`.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_normal(&self, scene: u64) -> Result<Vec<f32>, DatasetError> {
        let codes = self.read::<i16>(scene, Quantity::Normal).await?;
        Ok(codes.into_iter().map(|n| f32::from(n) / 32767.0).collect())
    }

    /// Visibility, 1 = lit: `[spot][row][column]`.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_visibility(&self, scene: u64) -> Result<Vec<u8>, DatasetError> {
        let packed = self.read::<u8>(scene, Quantity::Visibility).await?;
        let pixels = self.spec.pixels();
        let spot = |s: usize| {
            packed[s / 8 * pixels..][..pixels]
                .iter()
                .map(move |b| b >> (s % 8) & 1)
        };
        Ok((0..self.spec.spots as usize).flat_map(spot).collect())
    }

    /// The spots in the camera frame; `None` where a beam meets nothing.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_spots(&self, scene: u64) -> Result<Vec<Option<Spot>>, DatasetError> {
        let rows = self.read::<f32>(scene, Quantity::Spots).await?;
        Ok(rows.chunks_exact(7).map(Spot::from_row).collect())
    }

    /// Intrinsics.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_intrinsics(&self, scene: u64) -> Result<Intrinsics, DatasetError> {
        let v = self.read::<f32>(scene, Quantity::Intrinsics).await?;
        Ok(Intrinsics {
            fx: v[0],
            fy: v[1],
            cx: v[2],
            cy: v[3],
        })
    }
}

/// A part of the image being decoded into.
struct Window<'a> {
    rows: Range<usize>,
    columns: Range<usize>,
    target: &'a mut [f32],
}

/// Bytes as values, copied only where they are not aligned.
fn values<T: bytemuck::Pod>(bytes: &[u8]) -> Cow<'_, [T]> {
    match bytemuck::try_cast_slice(bytes) {
        Ok(values) => Cow::Borrowed(values),
        Err(_) => Cow::Owned(bytemuck::pod_collect_to_vec(bytes)),
    }
}
