//! A listing of a data set: sizes by array and scene, in eight bytes per object.

use futures::{StreamExt, TryStreamExt, stream};
use object_store::path::Path;

use crate::layout::group::METADATA;
use crate::layout::manifest::manifest_scene;
use crate::render_group::single::is_of_single;
use crate::repair::recipe;
use crate::scenes::dataset::Dataset;
use crate::scenes::parts::part_scene;
use crate::scenes::{snapshot, splits};
use picofarm_store::IDENTITY;
use picofarm_store::StorageError;

/// Size of a missing object.
const ABSENT: u64 = u64::MAX;

/// A listing of a data set. Manifests are listed before everything else, so that every object of a
/// listed manifest already existed when the objects were listed, even if workers publish
/// concurrently.
#[derive(Debug, Default)]
pub(crate) struct Listing {
    /// Scenes with a manifest, ascending.
    pub manifests: Vec<u64>,
    /// For each array, sizes by scene.
    sizes: Vec<Vec<u64>>,
    /// Keys of metadata.
    pub metadata: Vec<String>,
    /// Keys of snapshots, recipes and splits.
    pub records: Vec<String>,
    /// Keys of parts of scenes.
    pub parts: Vec<String>,
    /// Keys that do not belong to the data set.
    pub foreign: Vec<String>,
}

impl Listing {
    /// Returns the size of a scene's object in the array at this position.
    pub fn size(&self, array: usize, scene: u64) -> Option<u64> {
        let size = self.sizes[array].get(usize::try_from(scene).ok()?)?;
        (*size != ABSENT).then_some(*size)
    }

    /// Returns whether the scene has a manifest.
    pub fn is_published(&self, scene: u64) -> bool {
        self.manifests.binary_search(&scene).is_ok()
    }

    /// Returns one more than the largest scene with an object.
    pub fn end(&self) -> u64 {
        self.sizes.iter().map(Vec::len).max().unwrap_or(0) as u64
    }

    fn note(&mut self, array: usize, scene: u64, size: u64) {
        let sizes = &mut self.sizes[array];
        let at = scene as usize;
        if sizes.len() <= at {
            sizes.resize(at + 1, ABSENT);
        }
        sizes[at] = size;
    }
}

impl Dataset {
    /// Lists the data set, with its arrays concurrently.
    pub(crate) async fn listing(&self) -> Result<Listing, StorageError> {
        let mut listing = Listing {
            sizes: vec![Vec::new(); self.arrays.len()],
            ..Listing::default()
        };
        self.list_manifests(&mut listing).await?;
        let failed = |path: &Path| {
            let shown = self.shown(path);
            move |e| StorageError::store("list", shown.clone(), e)
        };
        let top = self.store.list_with_delimiter(Some(&self.prefix)).await;
        let top = top.map_err(failed(&self.prefix))?;
        for object in top.objects {
            self.sort_in(&mut listing, &object.location, object.size);
        }
        let manifests = self.path("manifests");
        let folders = top.common_prefixes.into_iter().filter(|p| *p != manifests);
        let lists = folders.map(|folder| self.store.list(Some(&folder)));
        let mut objects = stream::select_all(lists);
        while let Some(object) = objects.try_next().await.map_err(failed(&self.prefix))? {
            self.sort_in(&mut listing, &object.location, object.size);
        }
        Ok(listing)
    }

    async fn list_manifests(&self, listing: &mut Listing) -> Result<(), StorageError> {
        let folder = self.path("manifests");
        let failed = |e| StorageError::store("list", self.shown(&folder), e);
        let mut objects = self.store.list(Some(&folder));
        while let Some(object) = objects.next().await {
            let key = self.relative(&object.map_err(failed)?.location);
            match manifest_scene(&key) {
                Some(scene) => listing.manifests.push(scene),
                None => listing.foreign.push(key),
            }
        }
        listing.manifests.sort_unstable();
        Ok(())
    }

    fn sort_in(&self, listing: &mut Listing, path: &Path, size: u64) {
        let key = self.relative(path);
        if let Some((array, scene)) = self.object_place(&key) {
            listing.note(array, scene, size);
        } else if part_scene(&key).is_some() {
            listing.parts.push(key);
        } else if key == METADATA || self.is_array_metadata(&key) {
            listing.metadata.push(key);
        } else if snapshot::is_snapshot(&key) || recipe::is_recipe(&key) || splits::is_split(&key) {
            listing.records.push(key);
        } else if key != IDENTITY && !is_of_single(&key) {
            // The identity exists if the data set's folder was itself used as a store.
            listing.foreign.push(key);
        }
    }

    fn is_array_metadata(&self, key: &str) -> bool {
        let name = key
            .strip_suffix(METADATA)
            .and_then(|name| name.strip_suffix('/'));
        let mut arrays = self.arrays.iter();
        name.is_some_and(|name| arrays.any(|a| a.layout.quantity.name() == name))
    }

    /// Returns the array (by position) and the scene of the object with this key.
    pub(crate) fn object_place(&self, key: &str) -> Option<(usize, u64)> {
        let mut parts = key.split('/');
        let name = parts.next()?;
        let scene: u64 = parts.nth(1)?.parse().ok()?;
        let mut arrays = self.arrays.iter();
        let array = arrays.position(|a| a.layout.quantity.name() == name)?;
        let fits = scene < self.spec.scenes && self.arrays[array].layout.key(scene) == key;
        fits.then_some((array, scene))
    }
}
