//! Reads published scenes.

use std::ops::Range;

use bytes::Bytes;
use futures::{Stream, StreamExt, stream};

use crate::coding::tiles::Part;
use crate::layout::manifest::Manifest;
use crate::layout::quantity::{Element, Quantity};
use crate::layout::record::{Intrinsics, Spot};
use crate::layout::spec::Profile;
use crate::scenes::dataset::{ArrayCodec, Dataset};
use picofarm_store::StorageError;
use picofarm_store::objects::{self, Rereads};

/// An element type of stored arrays.
pub trait Stored: bytemuck::Pod + sealed::Stored {}

mod sealed {
    pub trait Stored {
        const ELEMENT: crate::layout::quantity::Element;
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
    /// Reads a scene's encoded object and checks its SHA-256 against the manifest.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn encoded_object(
        &self,
        array: &ArrayCodec,
        manifest: &Manifest,
    ) -> Result<Bytes, StorageError> {
        let key = array.layout.key(manifest.scene);
        let path = self.path(&key);
        let bytes = objects::require(&*self.store, &path).await?;
        if manifest.object(&key).map(|o| &o.sha256) == Some(&picofarm_store::sha256_hex(&bytes)) {
            return Ok(bytes);
        }
        Err(StorageError::Damaged {
            object: self.shown(&path),
            what: "its SHA-256 is not the manifest's".into(),
        })
    }

    /// Returns the manifest of a published scene, without checking its objects (see
    /// [`Self::published`]).
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<Manifest, StorageError> {
        let mut rereads = Rereads::new(&*self.store);
        loop {
            let read = self.manifest_once(scene).await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    async fn manifest_once(&self, scene: u64) -> Result<Manifest, StorageError> {
        self.check_scene(scene)?;
        self.published_scenes().scene(scene).await
    }

    /// Returns the indices of the published scenes, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, StorageError> {
        let mut scenes = self.published_scenes().list().await?;
        scenes.retain(|scene| *scene < self.spec.scenes);
        Ok(scenes)
    }

    /// Returns the decoded h of a scene, with the exact values of saturated bins:
    /// `[row][column][bin]`. Blocks its thread while rayon threads decode.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn read_transient(&self, scene: u64) -> Result<Vec<f32>, StorageError> {
        self.read_histogram(scene, Quantity::Transient).await
    }

    /// h of a scene from any of the data set's transients: `[row][column][bin]`, for
    /// `TransientSpots` `[spot][row][column][bin]`. Blocks its thread while decoding on rayon's
    /// threads.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the data set has no such transient; those of
    /// [`Self::read_transient`].
    pub async fn read_histogram(
        &self,
        scene: u64,
        quantity: Quantity,
    ) -> Result<Vec<f32>, StorageError> {
        let mut target = Vec::new();
        self.read_histogram_into(scene, quantity, &mut target)
            .await?;
        Ok(target)
    }

    /// Like [`Self::read_histogram`], but decodes into `target`, which is resized and overwritten.
    /// Reusing the buffer for many scenes avoids allocating 167 MB for each.
    ///
    /// # Errors
    /// Those of [`Self::read_histogram`]; the content of `target` is then unspecified.
    pub async fn read_histogram_into(
        &self,
        scene: u64,
        quantity: Quantity,
        target: &mut Vec<f32>,
    ) -> Result<(), StorageError> {
        let array = self.array_of(quantity)?;
        if !quantity.is_transient() {
            let what = format!("{} is no transient; use read", quantity.name());
            return Err(StorageError::invalid("quantity", what));
        }
        self.decode_into(scene, array, target, Self::decode_shard_into)
            .await
    }

    /// Fetches a scene's shard and decodes it into `target`, which is resized.
    async fn decode_into<T: Clone + Default>(
        &self,
        scene: u64,
        array: &ArrayCodec,
        target: &mut Vec<T>,
        decode: impl Fn(&Self, &Manifest, &ArrayCodec, &Bytes, &mut [T]) -> Result<(), StorageError>,
    ) -> Result<(), StorageError> {
        let mut rereads = Rereads::new(&*self.store);
        loop {
            let read = self.decode_once(scene, array, target, &decode).await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    async fn decode_once<T: Clone + Default>(
        &self,
        scene: u64,
        array: &ArrayCodec,
        target: &mut Vec<T>,
        decode: &impl Fn(&Self, &Manifest, &ArrayCodec, &Bytes, &mut [T]) -> Result<(), StorageError>,
    ) -> Result<(), StorageError> {
        let manifest = self.manifest_once(scene).await?;
        let key = array.layout.key(scene);
        let bytes = self.object(&manifest, &key).await?;
        let len = array.layout.planes() * self.spec.transient_len();
        if target.len() != len {
            // A new allocation is zeroed by the operating system; resizing would touch its pages
            // twice.
            *target = vec![T::default(); len];
        }
        decode(self, &manifest, array, &bytes, target).map_err(|e| self.damaged(e, &manifest, &key))
    }

    /// Reads h of a scene as one image per bin: `[bin][row][column]`, the order that networks
    /// expect. The stored order is the same, so no values are reordered. `target` is treated as in
    /// [`Self::read_histogram_into`].
    ///
    /// # Errors
    /// Those of [`Self::read_histogram`]; [`StorageError::Invalid`] for a transient of several
    /// images, such as [`Quantity::TransientSpots`].
    pub async fn read_planes_into(
        &self,
        scene: u64,
        quantity: Quantity,
        target: &mut Vec<f32>,
    ) -> Result<(), StorageError> {
        let array = self.single_transient(quantity)?;
        self.decode_into(scene, array, target, Self::decode_planes_into)
            .await
    }

    /// Reads the given bins of a window of h into `target`, as one image per bin:
    /// `[bin][row][column]`. A crop fetches and decodes only the inner chunks that overlap it.
    ///
    /// # Errors
    /// Those of [`Self::read_planes_into`] and [`Self::read_transient_part`];
    /// [`StorageError::Invalid`] if `target` has another size.
    pub async fn read_planes_part(
        &self,
        scene: u64,
        quantity: Quantity,
        [rows, columns, bins]: [Range<u32>; 3],
        target: &mut [f32],
    ) -> Result<(), StorageError> {
        let array = self.single_transient(quantity)?;
        let part = self.check_part(rows, columns, bins)?;
        if target.len() != part.len() {
            let what = format!("expected {} values, found {}", part.len(), target.len());
            return Err(StorageError::invalid("target", what));
        }
        let mut rereads = Rereads::new(&*self.store);
        loop {
            let read = async {
                let manifest = self.manifest_once(scene).await?;
                self.read_part_planes(&manifest, array, &part, target).await
            };
            let read = read.await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    /// Like [`Self::read_planes_into`], but copies the stored codes of the square-root profile
    /// ([`SquareRoot`](crate::SquareRoot)). The manifest has the values of saturated bins.
    ///
    /// # Errors
    /// Those of [`Self::read_planes_into`]; [`StorageError::Invalid`] for another profile.
    pub async fn read_codes_into(
        &self,
        scene: u64,
        quantity: Quantity,
        target: &mut Vec<u16>,
    ) -> Result<(), StorageError> {
        let array = self.single_transient(quantity)?;
        if !matches!(self.spec.profile, Profile::SqrtU16 { .. }) {
            let name = self.spec.profile.name();
            let what = format!("{name} has no codes of the square-root profile; read its values");
            return Err(StorageError::invalid("profile", what));
        }
        self.decode_into(scene, array, target, Self::copy_codes_into)
            .await
    }

    /// Returns the array of a transient of one image for each bin.
    fn single_transient(&self, quantity: Quantity) -> Result<&ArrayCodec, StorageError> {
        let array = self.array_of(quantity)?;
        if quantity.is_transient() && array.layout.planes() == 1 {
            return Ok(array);
        }
        let what = format!("{} is no single transient", quantity.name());
        Err(StorageError::invalid("quantity", what))
    }

    /// Returns a stream of h of many scenes, in the given order, with up to `ahead` of them being
    /// fetched and decoded concurrently. It is meant for training loops. If a scene cannot be read,
    /// the stream returns its error and continues with the next scene.
    ///
    /// # Panics
    /// Outside of a tokio runtime.
    pub fn read_transients(
        &self,
        scenes: Vec<u64>,
        ahead: usize,
    ) -> impl Stream<Item = (u64, Result<Vec<f32>, StorageError>)> + use<> {
        let dataset = self.clone();
        stream::iter(scenes)
            .map(move |scene| {
                let dataset = dataset.clone();
                async move { (scene, dataset.read_apart(scene).await) }
            })
            .buffered(ahead.max(1))
    }

    /// Reads a scene's transient and decodes it on a separate thread.
    async fn read_apart(self, scene: u64) -> Result<Vec<f32>, StorageError> {
        let mut rereads = Rereads::new(&*self.store);
        loop {
            let read = self.clone().read_apart_once(scene).await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    async fn read_apart_once(self, scene: u64) -> Result<Vec<f32>, StorageError> {
        let manifest = self.manifest_once(scene).await?;
        let path = self.path(&self.array(Quantity::Transient).layout.key(scene));
        let bytes = objects::require(&*self.store, &path).await?;
        let decoded = tokio::task::spawn_blocking(move || {
            self.decode_shard(&manifest, self.array(Quantity::Transient), &bytes)
                .map_err(|e| e.in_object(|| self.shown(&path)))
        });
        let broken = |e| StorageError::codec("cannot decode a scene", e);
        decoded.await.map_err(broken)?
    }

    /// Returns a window of h: `[row][column][bin]` for the given rows and columns. Fetches and
    /// decodes only the inner chunks that overlap it.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the window is empty or exceeds the image; those of
    /// [`Self::read_transient`].
    pub async fn read_transient_crop(
        &self,
        scene: u64,
        rows: Range<u32>,
        columns: Range<u32>,
    ) -> Result<Vec<f32>, StorageError> {
        self.read_transient_part(scene, rows, columns, 0..self.spec.gate.bins)
            .await
    }

    /// Like [`Self::read_transient_crop`], restricted to the given bins. Fetches and decodes only
    /// the inner chunks that overlap the part, which have 32×32 pixels and 128 bins.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if a range is empty or exceeds the transient; those of
    /// [`Self::read_transient`].
    pub async fn read_transient_part(
        &self,
        scene: u64,
        rows: Range<u32>,
        columns: Range<u32>,
        bins: Range<u32>,
    ) -> Result<Vec<f32>, StorageError> {
        let part = self.check_part(rows, columns, bins)?;
        let manifest = self.manifest(scene).await?;
        self.read_part(&manifest, self.array(Quantity::Transient), part)
            .await
    }

    /// Checks the ranges of a part of a single transient.
    fn check_part(
        &self,
        rows: Range<u32>,
        columns: Range<u32>,
        bins: Range<u32>,
    ) -> Result<Part, StorageError> {
        let limits = [
            ("rows", &rows, self.spec.height),
            ("columns", &columns, self.spec.width),
            ("bins", &bins, self.spec.gate.bins),
        ];
        for (field, range, limit) in limits {
            if range.is_empty() || range.end > limit {
                let what = format!(
                    "expected a range within 0..{limit} that is not empty, found {range:?}"
                );
                return Err(StorageError::invalid(field, what));
            }
        }
        let of = |range: Range<u32>| range.start as usize..range.end as usize;
        Ok(Part {
            rows: of(rows),
            columns: of(columns),
            bins: of(bins),
        })
    }

    /// Returns h of a single spot, from `transient_spots`: `[row][column][bin]`. Does not fetch or
    /// decode the other spots.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the data set has no such transient or no such spot; those of
    /// [`Self::read_transient`].
    pub async fn read_spot(&self, scene: u64, spot: u32) -> Result<Vec<f32>, StorageError> {
        let array = self.array_of(Quantity::TransientSpots)?;
        if spot >= self.spec.spots {
            let what = format!(
                "the data set has {} spots, counted from 0; found {spot}",
                self.spec.spots
            );
            return Err(StorageError::invalid("spot", what));
        }
        let (height, width) = (self.spec.height as usize, self.spec.width as usize);
        let top = spot as usize * height;
        let manifest = self.manifest(scene).await?;
        let part = Part {
            rows: top..top + height,
            columns: 0..width,
            bins: 0..self.spec.gate.bins as usize,
        };
        self.read_part(&manifest, array, part).await
    }

    /// Returns the stored values of a quantity other than a transient, in the shape given at
    /// [`Quantity`].
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if `T` is not the stored type or the quantity is a transient;
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn read<T: Stored>(
        &self,
        scene: u64,
        quantity: Quantity,
    ) -> Result<Vec<T>, StorageError> {
        let array = self.array_of(quantity)?;
        if quantity.is_transient() {
            return Err(StorageError::invalid(
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
            return Err(StorageError::invalid("quantity", what));
        }
        let mut rereads = Rereads::new(&*self.store);
        loop {
            let read = self.read_once(scene, array).await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    async fn read_once<T: Stored>(
        &self,
        scene: u64,
        array: &ArrayCodec,
    ) -> Result<Vec<T>, StorageError> {
        let key = array.layout.key(scene);
        let path = self.path(&key);
        if self.cache.is_some() {
            let manifest = self.manifest_once(scene).await?;
            let bytes = self.object(&manifest, &key).await?;
            let values = array.codec.decode(&bytes);
            let values = values.map_err(|e| self.damaged(e, &manifest, &key))?;
            return Ok(bytemuck::pod_collect_to_vec(&values));
        }
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            // Distinguishes an unpublished scene from one with a missing object.
            self.manifest_once(scene).await?;
            return Err(StorageError::Damaged {
                object: self.shown(&path),
                what: "the object is missing".into(),
            });
        };
        let values = array.codec.decode(&bytes);
        let values = values.map_err(|e| e.in_object(|| self.shown(&path)))?;
        Ok(bytemuck::pod_collect_to_vec(&values))
    }

    /// Returns the unit normals in the camera frame: `[row][column][3]`.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_normal(&self, scene: u64) -> Result<Vec<f32>, StorageError> {
        let codes = self.read::<i16>(scene, Quantity::Normal).await?;
        Ok(codes.into_iter().map(|n| f32::from(n) / 32767.0).collect())
    }

    /// Returns the visibility, 1 = lit: `[spot][row][column]`.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_visibility(&self, scene: u64) -> Result<Vec<u8>, StorageError> {
        let packed = self.read::<u8>(scene, Quantity::Visibility).await?;
        let pixels = self.spec.pixels();
        let spot = |s: usize| {
            packed[s / 8 * pixels..][..pixels]
                .iter()
                .map(move |b| b >> (s % 8) & 1)
        };
        Ok((0..self.spec.spots as usize).flat_map(spot).collect())
    }

    /// Returns the spots in the camera frame; `None` if a beam hits nothing.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_spots(&self, scene: u64) -> Result<Vec<Option<Spot>>, StorageError> {
        let rows = self.read::<f32>(scene, Quantity::Spots).await?;
        Ok(rows.chunks_exact(7).map(Spot::from_row).collect())
    }

    /// Returns the camera intrinsics.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub async fn read_intrinsics(&self, scene: u64) -> Result<Intrinsics, StorageError> {
        let v = self.read::<f32>(scene, Quantity::Intrinsics).await?;
        Ok(Intrinsics {
            fx: v[0],
            fy: v[1],
            cx: v[2],
            cy: v[3],
        })
    }
}
