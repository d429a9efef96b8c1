//! Creates, opens and grows data sets.

use std::sync::Arc;

use object_store::ObjectStore;
use object_store::path::Path;
use serde_json::{Map, Value, json};

use crate::coding::codec::ChunkCodec;
use crate::coding::profile::decode_lines;
use crate::layout::arrays::Layout;
use crate::layout::group::{
    METADATA, counts_fewer, create_metadata, is_predictions, is_reconstructions, pretty,
};
use crate::layout::manifest::{ENCODER_VERSION, FORMAT_VERSION, Manifest, other_format};
use crate::layout::quantity::Quantity;
use crate::layout::spec::DatasetSpec;
use picofarm_store::objects::{self, Rereads};
use picofarm_store::published::Published;
use picofarm_store::{Cache, StorageError};

/// An open data set: one Zarr v3 group in an object store. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Dataset {
    pub(crate) store: Arc<dyn ObjectStore>,
    pub(crate) prefix: Path,
    pub(crate) spec: DatasetSpec,
    pub(crate) arrays: Arc<[ArrayCodec]>,
    pub(crate) cache: Option<Cache>,
}

/// An array and its chunk codec.
#[derive(Debug)]
pub struct ArrayCodec {
    /// Its layout.
    pub layout: Layout,
    /// The codec of its objects, or of the inner chunks of its shards.
    pub codec: ChunkCodec,
}

impl Dataset {
    /// Creates the data set at `prefix`, or opens an existing one.
    ///
    /// The metadata are written create-only, the root last: a data set exists once its root
    /// `zarr.json` does. Where the stored number of scenes is smaller than `spec.scenes`, the data
    /// set grows: the first number of every array's shape is replaced, the root's last. Where it is
    /// larger, the stored number stands. Of several processes that grow it at a time the largest
    /// number stays: each object is replaced only where it counts fewer scenes, and in stores with
    /// conditional puts only if it is still the one that was looked at. A folder has no such put:
    /// of two that replace an object within the same instant the smaller number may stay, until the
    /// next scene of the larger one is made (published scenes are never touched).
    ///
    /// ```
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), picofarm_store::StorageError> {
    /// use object_store::{memory::InMemory, path::Path};
    /// use picofarm_dataset::{Dataset, DatasetSpec, Gate, Profile, Subsets, Wavelength};
    /// use picofarm_store::StorageError;
    ///
    /// let store = std::sync::Arc::new(InMemory::new());
    /// let spec = DatasetSpec {
    ///     scenes: 2,
    ///     height: 8,
    ///     width: 8,
    ///     spots: 4,
    ///     subsets: Subsets::NONE,
    ///     per_spot: false,
    ///     wavelengths_nm: Wavelength::NONE,
    ///     two_bounce: false,
    ///     gate: Gate { start_m: 0.0, bin_width_m: 0.05, bins: 32 },
    ///     profile: Profile::default(),
    /// };
    /// let rooms = Dataset::create_or_open(store.clone(), Path::from("rooms"), &spec).await?;
    /// assert!(rooms.scenes_present().await?.is_empty());
    /// let wide = DatasetSpec { width: 16, ..spec };
    /// let other = Dataset::create_or_open(store, Path::from("rooms"), &wide).await;
    /// assert!(matches!(other, Err(StorageError::SpecMismatch { .. })));
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// [`StorageError::SpecMismatch`] names the first differing field and both values;
    /// [`StorageError::Invalid`]; [`StorageError::Store`].
    pub async fn create_or_open(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
        spec: &DatasetSpec,
    ) -> Result<Self, StorageError> {
        spec.check()?;
        let root = objects::path_of(&prefix, METADATA);
        let stored = match objects::get(&*store, &root).await? {
            Some(bytes) => parse_root(&bytes, &objects::shown(&*store, &root))?,
            None => {
                let new = Self::assume(store.clone(), prefix.clone(), *spec);
                for array in new.arrays.iter() {
                    new.create_array_metadata(&array.layout).await?;
                }
                if objects::create(&*store, &root, pretty(&root_metadata(spec))).await? {
                    return Ok(new);
                }
                // Another process created it first.
                parse_root(
                    &objects::require(&*store, &root).await?,
                    &objects::shown(&*store, &root),
                )?
            }
        };
        if let Some((field, stored, asked)) = stored.difference(spec) {
            return Err(StorageError::SpecMismatch {
                prefix: objects::shown(&*store, &prefix),
                field: field.into(),
                stored,
                asked,
            });
        }
        if spec.scenes <= stored.scenes {
            return Ok(Self::assume(store, prefix, stored));
        }
        let grown = Self::assume(store, prefix, *spec);
        for array in grown.arrays.iter() {
            let path = grown.metadata_path(&array.layout);
            let bytes = pretty(&array.layout.metadata(spec.scenes));
            objects::grow(&*grown.store, &path, bytes, |stored| {
                counts_fewer(stored, spec.scenes)
            })
            .await?;
        }
        let bytes = pretty(&root_metadata(spec));
        let place = objects::shown(&*grown.store, &root);
        objects::grow(&*grown.store, &root, bytes, |stored| {
            parse_root(stored, &place).map_or(true, |stored| stored.scenes < spec.scenes)
        })
        .await?;
        Ok(grown)
    }

    /// Opens the data set at `prefix`.
    ///
    /// # Errors
    /// [`StorageError::NoDataset`], [`StorageError::Damaged`] if the root is not a picofarm data
    /// set, [`StorageError::Store`].
    pub async fn open(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Self, StorageError> {
        let mut rereads = Rereads::new(&*store);
        loop {
            let read = Self::open_once(store.clone(), prefix.clone()).await;
            match rereads.pause(&read) {
                None => return read,
                Some(pause) => tokio::time::sleep(pause).await,
            }
        }
    }

    async fn open_once(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Self, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let Some(bytes) = objects::get(&*store, &root).await? else {
            return Err(StorageError::NoDataset {
                prefix: objects::shown(&*store, &prefix),
            });
        };
        let spec = parse_root(&bytes, &objects::shown(&*store, &root))?;
        Ok(Self::assume(store, prefix, spec))
    }

    /// Returns the data set's stored properties.
    pub fn spec(&self) -> &DatasetSpec {
        &self.spec
    }

    /// Returns the store.
    pub fn store(&self) -> &Arc<dyn ObjectStore> {
        &self.store
    }

    /// Returns the arrays, in the order of their objects in a manifest.
    pub fn arrays(&self) -> &[ArrayCodec] {
        &self.arrays
    }

    /// Returns the published scenes. Scenes are checked by [`Self::verify`] and restored by
    /// [`Self::restore`], which also know the data set's specification, its listing and snapshots.
    pub(crate) fn published_scenes(&self) -> Published<Manifest> {
        Published::new(self.store.clone(), self.prefix.clone())
    }

    /// Returns its path in the store.
    pub fn prefix(&self) -> &Path {
        &self.prefix
    }

    /// Returns its location for messages.
    pub fn place(&self) -> String {
        self.shown(&self.prefix)
    }

    pub(crate) fn assume(store: Arc<dyn ObjectStore>, prefix: Path, spec: DatasetSpec) -> Self {
        let array = |quantity: Quantity| {
            let layout = quantity.layout(&spec);
            let codec = ChunkCodec::new(&layout);
            ArrayCodec { layout, codec }
        };
        Self {
            store,
            prefix,
            spec,
            arrays: spec.quantities().into_iter().map(array).collect(),
            cache: None,
        }
    }

    /// Returns an array that every data set has.
    ///
    /// # Panics
    /// If `quantity` is a transient of a subset that the data set lacks.
    pub fn array(&self, quantity: Quantity) -> &ArrayCodec {
        self.array_of(quantity)
            .expect("only transients of subsets may be missing")
    }

    /// Returns the array of any quantity.
    pub(crate) fn array_of(&self, quantity: Quantity) -> Result<&ArrayCodec, StorageError> {
        let found = self.arrays.iter().find(|a| a.layout.quantity == quantity);
        found.ok_or_else(|| {
            let what = format!("the data set has no array {}", quantity.name());
            StorageError::invalid("quantity", what)
        })
    }

    /// Returns the path of an object, given by its key relative to the data set.
    pub fn path(&self, key: &str) -> Path {
        objects::path_of(&self.prefix, key)
    }

    /// Returns the key of a path relative to the prefix.
    pub fn relative(&self, path: &Path) -> String {
        let parts = path.parts().skip(self.prefix.parts().count());
        let parts: Vec<String> = parts.map(|part| part.as_ref().to_string()).collect();
        parts.join("/")
    }

    /// Formats a path for messages.
    pub fn shown(&self, path: &Path) -> String {
        objects::shown(&*self.store, path)
    }

    pub(crate) fn metadata_path(&self, layout: &Layout) -> Path {
        self.path(&format!("{}/{METADATA}", layout.quantity.name()))
    }

    pub(crate) fn check_scene(&self, scene: u64) -> Result<(), StorageError> {
        if scene < self.spec.scenes {
            return Ok(());
        }
        Err(StorageError::SceneOutOfRange {
            scene,
            scenes: self.spec.scenes,
        })
    }

    /// Writes an array's metadata before the root exists.
    async fn create_array_metadata(&self, layout: &Layout) -> Result<(), StorageError> {
        let path = self.metadata_path(layout);
        create_metadata(&*self.store, &path, self.spec.scenes, |n| {
            layout.metadata(n)
        })
        .await
    }
}

/// Returns the root's `zarr.json`: attributes and the consolidated metadata of all arrays.
pub fn root_metadata(spec: &DatasetSpec) -> Value {
    let arrays: Map<String, Value> = spec
        .quantities()
        .into_iter()
        .map(|q| {
            let layout = q.layout(spec);
            (q.name().to_string(), layout.metadata(spec.scenes))
        })
        .collect();
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {
            "picofarm": {"format": FORMAT_VERSION, "encoder": ENCODER_VERSION, "spec": spec},
            "gate": spec.gate,
            "bin": "bin b holds optical path lengths [start_m + b*bin_width_m, start_m + (b+1)*bin_width_m)",
            "speed_of_light_m_s": 299_792_458,
            "units": "lengths in metres, times as optical path in metres, images [row][column]",
            "visibility_polarity": "1 = lit",
            "decode": decode_lines(spec),
        },
        "consolidated_metadata": {"kind": "inline", "must_understand": false, "metadata": arrays},
    })
}

/// Parses the data set's properties.
fn parse_root(bytes: &[u8], object: &str) -> Result<DatasetSpec, StorageError> {
    let damaged = |what: String| StorageError::Damaged {
        object: object.to_string(),
        what,
    };
    let root: Value = serde_json::from_slice(bytes)
        .map_err(|e| damaged(format!("not JSON ({e}), so no Zarr group")))?;
    if is_predictions(&root) {
        let what = "holds what models predict of the scenes of a data set, and is no data set itself; its manifests name the one \
                    that it is about";
        return Err(StorageError::invalid(object, what));
    }
    if is_reconstructions(&root) {
        let what = "holds reconstructions of the scenes of a data set, and is no data set itself; `dataset info`, \
                    `verify`, `picture` and `report` read it";
        return Err(StorageError::invalid(object, what));
    }
    let ours = &root["attributes"]["picofarm"];
    let Some(format) = ours["format"].as_u64() else {
        return Err(damaged(
            "a Zarr group, but not a picofarm data set (attributes.picofarm.format is missing)"
                .into(),
        ));
    };
    if format != u64::from(FORMAT_VERSION) {
        return Err(damaged(other_format(format)));
    }
    let spec: DatasetSpec = serde_json::from_value(ours["spec"].clone())
        .map_err(|e| damaged(format!("attributes.picofarm.spec: {e}")))?;
    spec.check()?;
    Ok(spec)
}
