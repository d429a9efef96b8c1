//! What jobs made of scenes: predictions of one-flash processing and of networks, and
//! reconstructions in 3D.

use std::sync::Arc;

use bytes::Bytes;
use object_store::{ObjectStore, ObjectStoreExt, path::Path};
use picofarm_dataset::Manifest;
use picofarm_results::{Predicted, Predictions, Reconstructions};
use picofarm_store::StorageError;
use serde_json::{Value, json};

use super::{SceneId, Stores, truth::Truth};
use crate::answer::Problem;

/// The mesh of a reconstruction.
const MESH: &str = "mesh.glb";
/// Its errors and facts.
const METRICS: &str = "metrics.json";
/// Most bytes of a mesh that is sent to a browser.
const MOST: u64 = 256 << 20;

/// A group of results about scenes.
#[derive(Debug, Clone)]
pub struct Made {
    /// Its name in URLs, as of a data set.
    pub id: String,
    /// Its location for people.
    pub place: String,
    /// The results.
    pub kind: Kind,
}

/// The kinds of results.
#[derive(Debug, Clone)]
pub enum Kind {
    /// Depth, masks and mirrors.
    Predictions(Predictions),
    /// Rooms in 3D, with their scenes, ascending.
    Reconstructions(Reconstructions, Vec<u64>),
    /// A folder of `picofarm reconstruct`, with one room.
    Folder,
}

impl Kind {
    /// Opens what a group other than a data set contains; `None` if it is neither predictions nor
    /// reconstructions.
    ///
    /// # Errors
    /// Fails if the group is damaged, and if the store fails.
    pub async fn open(
        store: &Arc<dyn ObjectStore>,
        prefix: &Path,
    ) -> Result<Option<Self>, StorageError> {
        if let Some(found) = Predictions::find(Arc::clone(store), prefix.clone()).await? {
            return Ok(Some(Self::Predictions(found)));
        }
        match Reconstructions::open(Arc::clone(store), prefix.clone()).await {
            Ok(rooms) => {
                let scenes = rooms.scenes_present().await?;
                Ok(Some(Self::Reconstructions(rooms, scenes)))
            }
            Err(StorageError::Invalid { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

impl Made {
    /// Returns whether a folder's objects are those of `picofarm reconstruct`.
    pub fn is_room(objects: &[object_store::ObjectMeta]) -> bool {
        let has = |name| objects.iter().any(|o| o.location.filename() == Some(name));
        has(MESH) && has(METRICS)
    }

    /// Returns the scenes that it has in 3D.
    pub fn rooms(&self) -> &[u64] {
        match &self.kind {
            Kind::Predictions(_) => &[],
            Kind::Reconstructions(_, scenes) => scenes,
            Kind::Folder => &[0],
        }
    }
}

/// A room in 3D.
pub struct Room {
    /// The mesh as binary glTF.
    pub mesh: Bytes,
    /// Facts and errors.
    pub metrics: Value,
    /// The scene that it was made of, where a store of this server has it.
    pub source: Option<SceneId>,
}

impl Stores {
    /// Reads a room in 3D.
    ///
    /// # Errors
    /// Fails if there is none, and if it cannot be read.
    pub async fn room(&self, id: &SceneId) -> Result<Room, Problem> {
        let (store, prefix) = self.open_at(&id.set)?;
        let missing = || {
            Problem::missing(format!(
                "set: {:?} has no scene {} in 3D; expected reconstructions of a job, or a folder of \
                 `picofarm reconstruct`",
                id.set, id.scene
            ))
        };
        let (mesh, metrics, source) = match Reconstructions::open(store.clone(), prefix.clone())
            .await
        {
            Ok(rooms) => {
                let manifest = rooms.manifest(id.scene).await?;
                let (mesh, metrics) =
                    futures::try_join!(rooms.read(id.scene, MESH), rooms.read(id.scene, METRICS))?;
                (mesh, metrics, Some(manifest.source.task_key))
            }
            Err(StorageError::NoDataset { .. }) if id.scene == 0 => {
                let read = |name: &'static str| {
                    let path = prefix.clone().join(name);
                    let store = store.clone();
                    async move {
                        let found = store.get(&path).await.map_err(|_| missing())?;
                        if found.meta.size > MOST {
                            let what = format!(
                                "{path} has {} bytes; meshes have at most {MOST}",
                                found.meta.size
                            );
                            let status = http::StatusCode::PAYLOAD_TOO_LARGE;
                            return Err(Problem::new(status, what));
                        }
                        let broken = |e| StorageError::store("read", path.to_string(), e);
                        Ok::<_, Problem>(found.bytes().await.map_err(broken)?)
                    }
                };
                let (mesh, metrics) = futures::try_join!(read(MESH), read(METRICS))?;
                (mesh, metrics, None)
            }
            Err(StorageError::NoDataset { .. } | StorageError::Invalid { .. }) => {
                return Err(missing());
            }
            Err(error) => return Err(error.into()),
        };
        let metrics = serde_json::from_slice(&metrics).map_err(|e| StorageError::Damaged {
            object: format!("{}/{METRICS}", id.set),
            what: format!("not JSON ({e})"),
        })?;
        let source = match source {
            Some(task_key) => self.with_key(id.scene, &task_key).await,
            None => None,
        };
        Ok(Room {
            mesh,
            metrics,
            source,
        })
    }

    /// Returns the scene of this index that a task made, in any of the data sets.
    async fn with_key(&self, scene: u64, task_key: &str) -> Option<SceneId> {
        for set in &self.recent().await.sets {
            if set.scenes.binary_search(&scene).is_ok()
                && let Ok(manifest) = set.dataset.manifest(scene).await
                && manifest.provenance.task_key == task_key
            {
                let set = set.id.clone();
                return Some(SceneId { set, scene });
            }
        }
        None
    }

    /// Returns the reconstructions of a scene, each with its location.
    pub async fn rooms_of(&self, scene: &Manifest) -> Vec<(SceneId, String)> {
        let mut found = Vec::new();
        for made in &self.recent().await.made {
            if let Kind::Reconstructions(rooms, scenes) = &made.kind
                && scenes.binary_search(&scene.scene).is_ok()
                && let Ok(manifest) = rooms.manifest(scene.scene).await
                && manifest.source.task_key == scene.provenance.task_key
            {
                let set = made.id.clone();
                let scene = scene.scene;
                found.push((SceneId { set, scene }, made.place.clone()));
            }
        }
        found
    }

    /// Returns what predictions of a scene say of a pixel: depth in metres, confidence, and for
    /// each spot the probability of light with the time at that depth. Predictions that cannot be
    /// read have a `problem` in their place.
    ///
    /// # Errors
    /// Fails if an array that the times follow from is damaged.
    pub async fn seen(&self, truth: &Truth, pixel: usize) -> Result<Vec<Value>, Problem> {
        let scene = truth.manifest.scene;
        let mut found = Vec::new();
        for made in &self.recent().await.made {
            let Kind::Predictions(predictions) = &made.kind else {
                continue;
            };
            let manifest = match predictions.manifest(scene).await {
                Ok(manifest) => manifest,
                Err(StorageError::NotPublished { .. }) => continue,
                Err(error) => {
                    found.push(json!({"place": made.place, "problem": error.to_string()}));
                    continue;
                }
            };
            if manifest.source.task_key != truth.manifest.provenance.task_key {
                continue;
            }
            let key = (made.id.clone(), manifest.task_key.clone());
            let predicted = match self.predicted.get(&key) {
                Some(predicted) => predicted,
                None => match predictions.read(scene).await {
                    Ok(predicted) => {
                        let predicted = Arc::new(predicted);
                        let bytes = 6 * truth.spec.pixels() + predicted.lit.len();
                        self.predicted.insert(key, Arc::clone(&predicted), bytes);
                        predicted
                    }
                    Err(error) => {
                        found.push(json!({"place": made.place, "problem": error.to_string()}));
                        continue;
                    }
                },
            };
            let mut says = says(truth, &predicted, pixel)?;
            says["place"] = json!(made.place);
            let models = manifest.models.values().map(|model| &*model.name);
            says["flash"] = json!(models.clone().any(|name| name == "demultiplex"));
            found.push(says);
        }
        Ok(found)
    }
}

fn says(truth: &Truth, predicted: &Predicted, pixel: usize) -> Result<Value, Problem> {
    let share = |values: &[u8]| values.get(pixel).map(|p| f64::from(*p) / 255.0);
    let depth = predicted.depth_m.get(pixel).copied();
    let point = match depth {
        Some(depth) => truth.point_at(pixel, depth)?,
        None => truth.point(pixel)?,
    };
    let pixels = truth.spec.pixels().max(1);
    let spots = truth.spots.as_ref()?.iter().enumerate();
    let lit = spots.zip(predicted.lit.chunks_exact(pixels));
    let lit = lit.filter_map(|((index, spot), mask)| {
        let path = super::histogram::two_bounce(spot.as_ref()?, point?);
        Some(json!({"spot": index, "share": f64::from(mask[pixel]) / 255.0, "path_m": path}))
    });
    Ok(json!({
        "depth_m": depth, "range_m": point.filter(|_| depth.is_some()).map(super::histogram::length),
        "confidence": share(&predicted.confidence), "mirror": share(&predicted.specular),
        "lit": lit.collect::<Vec<_>>(),
    }))
}
