//! Facts from the manifests of a data set's scenes, for the filters of its gallery. Manifests are
//! read when a filter first needs them, a part for each request, and kept.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use futures::{StreamExt, stream};
use picofarm_dataset::Manifest;
use picofarm_store::{StorageError, published::Manifest as _};
use serde_json::Value;

use super::{DataSet, Stores};
use crate::answer::Problem;

/// Manifests that are read at a time.
const AT_ONCE: usize = 32;
/// Time after which no further manifest is read for a request.
const PATIENCE: Duration = Duration::from_millis(400);
/// Data sets whose contents are kept.
const KEPT: usize = 16;

/// Facts from a scene's manifest.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Content {
    /// The type of its room; empty if it has none.
    pub room: String,
    /// Its stated error: the median over pixels, as a share.
    pub error: Option<f64>,
    /// Rays that were traced for it.
    pub rays: Option<u64>,
    /// Whether its renderer found planar mirrors.
    pub mirrors: bool,
    /// Bytes of its objects.
    pub bytes: u64,
    /// Why its manifest cannot be used, if it is damaged.
    pub damage: Option<String>,
}

/// The contents of a data set, as far as they were read.
#[derive(Debug, Default)]
pub struct Contents {
    scenes: HashMap<u64, Content>,
}

/// The contents of all data sets, the least recent first.
#[derive(Default)]
pub struct Catalogue(Mutex<Vec<(String, Arc<tokio::sync::Mutex<Contents>>)>>);

impl Content {
    fn of_manifest(manifest: &Manifest) -> Self {
        let plan = &manifest.provenance.plan;
        let strategies = plan["strategies"].as_array().into_iter().flatten();
        let mut strategies = strategies.filter_map(Value::as_str);
        Self {
            room: plan["scene"]["notes"]["room_type"]
                .as_str()
                .unwrap_or_default()
                .to_owned(),
            error: plan["error"]["median_relative"].as_f64(),
            rays: plan["rays"].as_u64(),
            mirrors: strategies.any(|strategy| strategy.starts_with("mirror images")),
            bytes: manifest.total_bytes(),
            damage: None,
        }
    }
}

impl Contents {
    /// Returns the facts from a scene's manifest, if it was read.
    pub fn get(&self, scene: u64) -> Option<&Content> {
        self.scenes.get(&scene)
    }

    /// Returns the number of scenes that were read.
    pub fn len(&self) -> usize {
        self.scenes.len()
    }

    /// Returns the types of rooms.
    pub fn rooms(&self) -> BTreeSet<&str> {
        let rooms = self.scenes.values().map(|content| &*content.room);
        rooms.filter(|room| !room.is_empty()).collect()
    }
}

impl Catalogue {
    fn of_set(&self, id: &str) -> Arc<tokio::sync::Mutex<Contents>> {
        let mut all = self.0.lock().expect("no holder panics");
        let found = all.iter().position(|(other, _)| other == id);
        let held = match found {
            Some(at) => all.remove(at),
            None => (id.to_owned(), Arc::default()),
        };
        let contents = Arc::clone(&held.1);
        all.push(held);
        if all.len() > KEPT {
            all.remove(0);
        }
        contents
    }
}

impl Stores {
    /// Reads manifests of a data set for a while, and returns the facts from all that were read.
    ///
    /// # Errors
    /// Fails if the store fails.
    pub async fn contents(
        &self,
        set: &DataSet,
    ) -> Result<tokio::sync::OwnedMutexGuard<Contents>, Problem> {
        let mut contents = self.catalogue.of_set(&set.id).lock_owned().await;
        let start = Instant::now();
        let unread = set.scenes.iter().filter(|s| contents.get(**s).is_none());
        let unread: Vec<u64> = unread.copied().collect();
        let mut read = stream::iter(unread)
            .map(async |scene| (scene, set.dataset.manifest(scene).await))
            .buffered(AT_ONCE);
        while start.elapsed() < PATIENCE
            && let Some((scene, manifest)) = read.next().await
        {
            let content = match manifest {
                Ok(manifest) => Content::of_manifest(&manifest),
                Err(StorageError::Damaged { object, what }) => Content {
                    damage: Some(format!("{object} {what}")),
                    ..Content::default()
                },
                // It was removed after the list was made.
                Err(StorageError::NotPublished { .. }) => continue,
                Err(error) => return Err(error.into()),
            };
            contents.scenes.insert(scene, content);
        }
        Ok(contents)
    }
}
