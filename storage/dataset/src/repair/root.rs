//! Recovers a data set with a broken or lost root `zarr.json` from a recipe and the arrays'
//! metadata.

use std::sync::Arc;

use object_store::ObjectStore;
use object_store::path::Path;
use serde_json::Value;

use crate::layout::group::{METADATA, pretty};
use crate::layout::spec::{DatasetSpec, Gate, Profile, Subsets, Wavelength};
use crate::repair::recipe::Recipe;
use crate::scenes::dataset::{Dataset, root_metadata};
use picofarm_store::StorageError;
use picofarm_store::objects;

/// The objects that remain without the root.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Remains {
    /// The recipes.
    pub recipes: Vec<Recipe>,
    /// A scene with a readable manifest, and the key of the task that produced it.
    pub scene: Option<(u64, String)>,
}

/// Examines a data set that cannot be opened.
///
/// # Errors
/// [`StorageError::Store`], [`StorageError::Damaged`].
pub async fn remains(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Remains, StorageError> {
    let anything = DatasetSpec {
        scenes: u64::MAX,
        height: 1,
        width: 1,
        spots: 1,
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 1.0,
            bins: 1,
        },
        profile: Profile::LOSSLESS,
    };
    let blind = Dataset::assume(store, prefix, anything);
    let mut found = Remains::default();
    for scene in blind.scenes_present().await? {
        match blind.manifest(scene).await {
            Ok(manifest) => {
                found.scene = Some((scene, manifest.provenance.task_key));
                break;
            }
            Err(StorageError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    let scene = found.scene.as_ref().map_or(0, |(scene, _)| *scene);
    for key in blind.recipe_keys().await? {
        found.recipes.extend(blind.recipe(&key, scene).await?);
    }
    Ok(found)
}

impl Dataset {
    /// Returns whether the root's metadata is consistent: it equals the metadata derived from the
    /// properties that it states.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if it has gone missing; [`StorageError::Store`].
    pub async fn root_agrees(&self) -> Result<bool, StorageError> {
        let bytes = objects::require(&*self.store, &self.path(METADATA)).await?;
        let stored: Option<Value> = serde_json::from_slice(&bytes).ok();
        Ok(stored == Some(root_metadata(&self.spec)))
    }
}

/// Writes the root's metadata of a data set with these properties; the number of scenes is taken
/// from the arrays. All readable metadata of arrays must match `spec`, and at least one array's
/// must be readable.
///
/// # Errors
/// [`StorageError::Damaged`] if the arrays do not prove that it is this data set; in that case
/// nothing is written. [`StorageError::Store`].
pub async fn restore_root(
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    spec: &DatasetSpec,
) -> Result<Dataset, StorageError> {
    let mut spec = *spec;
    let assumed = Dataset::assume(store.clone(), prefix.clone(), spec);
    let mut agreed = None;
    for array in assumed.arrays.iter() {
        let path = assumed.metadata_path(&array.layout);
        let Some(bytes) = objects::get(&*store, &path).await? else {
            continue;
        };
        let Ok(stored) = serde_json::from_slice::<Value>(&bytes) else {
            continue;
        };
        let scenes = stored["shape"][0].as_u64().unwrap_or(0);
        if stored == array.layout.metadata(scenes) && agreed.is_none_or(|n| n == scenes) {
            agreed = Some(scenes);
            continue;
        }
        return Err(StorageError::Damaged {
            object: assumed.shown(&path),
            what: "is not what the recipe of the data set gives, while the root is broken too: nothing was written".into(),
        });
    }
    let root = assumed.path(METADATA);
    let Some(scenes) = agreed.filter(|n| *n > 0) else {
        return Err(StorageError::Damaged {
            object: assumed.shown(&root),
            what: "is broken, and so are the metadata of every array: nothing says how many scenes there are".into(),
        });
    };
    spec.scenes = scenes;
    spec.check()?;
    objects::overwrite(&*store, &root, pretty(&root_metadata(&spec))).await?;
    Dataset::open(store, prefix).await
}
