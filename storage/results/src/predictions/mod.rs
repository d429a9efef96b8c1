//! Predictions of scenes by models: a separate Zarr v3 group in a store, next to the data set of
//! the input scenes. It has the same number of scenes, and one object per scene and array: `depth`,
//! `lit`, `specular` and `confidence`, as far as they are predicted.
//!
//! A scene's predictions are published like scenes: objects first, `manifests/<scene>.json` last,
//! all create-only and pure functions of the task.

mod array;
mod evaluation;
mod manifest;
mod restore;
mod verify;

use std::sync::Arc;

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use array::{Plate, plates};
use manifest::FORMAT;
use picofarm_dataset::Manifest;
use picofarm_dataset::{METADATA, create_metadata, is_predictions, pretty};
use picofarm_store::StorageError;
use picofarm_store::many::{CONCURRENCY, put_again, put_all};
use picofarm_store::objects;
use picofarm_store::published::scenes_in;
use picofarm_store::sealed::{ObjectEntry, sha256_hex};
use picofarm_store::verify::intact;

pub use manifest::{ModelUsed, PredictionManifest, SceneUsed, TimesUsed};

/// The predicted quantities and the number of scenes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictionSpec {
    /// Capacity in scenes.
    pub scenes: u64,
    /// Image height in pixels.
    pub height: u32,
    /// Image width in pixels.
    pub width: u32,
    /// Whether depth is predicted.
    pub depth: bool,
    /// Spots of the source with predicted masks, in the order of `lit`; empty = no masks.
    pub spots: Vec<u32>,
    /// Whether mirrors are predicted.
    pub specular: bool,
    /// Whether the confidence of the depth is stored.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub confidence: bool,
}

/// The predictions of one scene, for the group's arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Predicted {
    /// z-depth, metres: `[row][column]`.
    pub depth_m: Vec<f32>,
    /// Probability times 255 that a spot lights the visible point: `[spot][row][column]`.
    pub lit: Vec<u8>,
    /// Probability times 255 of a mirror: `[row][column]`.
    pub specular: Vec<u8>,
    /// Confidence of the depth, times 255: `[row][column]`.
    pub confidence: Vec<u8>,
}

/// A pinned list of scenes' predictions of a quantity.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PinnedDepths {
    /// Hash that pins every byte of the predictions, and the order of the scenes, in hexadecimal.
    pub id: String,
    /// The model that predicted them; `None` if there are no scenes.
    pub model: Option<ModelUsed>,
}

/// Encoded predictions of one scene, ready to be published.
#[derive(Debug, Clone)]
pub struct EncodedPredictions {
    /// Their manifest.
    pub manifest: PredictionManifest,
    bytes: Vec<Bytes>,
}

/// Predictions in a store. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Predictions {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    spec: PredictionSpec,
    plates: Arc<[Plate]>,
}

impl Predictions {
    /// Creates the group at `prefix`, or opens an existing one. It grows to `spec.scenes` as data
    /// sets do.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the location contains something else;
    /// [`StorageError::SpecMismatch`]; [`StorageError::Store`].
    pub async fn create_or_open(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
        spec: &PredictionSpec,
    ) -> Result<Self, StorageError> {
        let asked = Self::assume(store.clone(), prefix.clone(), spec.clone());
        let root = asked.path(METADATA);
        let stored = match objects::get(&*store, &root).await? {
            Some(bytes) => parse_root(&bytes, &asked.shown(&root))?,
            None => {
                for plate in asked.plates.iter() {
                    let path = asked.metadata_path(plate);
                    create_metadata(&*store, &path, spec.scenes, |n| plate.metadata(n)).await?;
                }
                if objects::create(&*store, &root, pretty(&asked.root())).await? {
                    return Ok(asked);
                }
                // Another worker created it first.
                let bytes = objects::require(&*store, &root).await?;
                parse_root(&bytes, &asked.shown(&root))?
            }
        };
        if let Some((field, stored, asked)) = difference(&stored, spec) {
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
        for plate in asked.plates.iter() {
            let bytes = pretty(&plate.metadata(spec.scenes));
            objects::overwrite(&*store, &asked.metadata_path(plate), bytes).await?;
        }
        objects::overwrite(&*store, &root, pretty(&asked.root())).await?;
        Ok(asked)
    }

    /// Opens the group at `prefix`.
    ///
    /// # Errors
    /// [`StorageError::NoDataset`]; [`StorageError::Invalid`] if the location contains something
    /// else; [`StorageError::Store`].
    pub async fn open(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Self, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let Some(bytes) = objects::get(&*store, &root).await? else {
            return Err(StorageError::NoDataset {
                prefix: objects::shown(&*store, &prefix),
            });
        };
        let spec = parse_root(&bytes, &objects::shown(&*store, &root))?;
        Ok(Self::assume(store, prefix, spec))
    }

    /// Like [`Self::open`], but returns `None` if there are no predictions at `prefix`.
    ///
    /// # Errors
    /// [`StorageError::Invalid`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn find(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
    ) -> Result<Option<Self>, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let bytes = objects::get(&*store, &root).await?;
        let parsed = bytes.and_then(|bytes| serde_json::from_slice::<Value>(&bytes).ok());
        match parsed.is_some_and(|root| is_predictions(&root)) {
            true => Self::open(store, prefix).await.map(Some),
            false => Ok(None),
        }
    }

    fn assume(store: Arc<dyn ObjectStore>, prefix: Path, spec: PredictionSpec) -> Self {
        Self {
            store,
            prefix,
            plates: plates(&spec).into(),
            spec,
        }
    }

    /// Returns the predicted quantities.
    pub fn spec(&self) -> &PredictionSpec {
        &self.spec
    }

    /// Returns its location for messages.
    pub fn place(&self) -> String {
        self.shown(&self.prefix)
    }

    /// Returns the scenes with published predictions, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, StorageError> {
        scenes_in(&*self.store, &self.path("manifests")).await
    }

    /// Returns the manifest of a scene's predictions.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<PredictionManifest, StorageError> {
        let path = self.path(&Manifest::key(scene));
        match objects::get(&*self.store, &path).await? {
            Some(bytes) => PredictionManifest::parse(&bytes, scene, &self.shown(&path)),
            None => Err(StorageError::NotPublished {
                scene,
                object: self.shown(&path),
            }),
        }
    }

    /// Returns the manifest of a scene that this task has published, after checking the SHA-256 of
    /// each object. This check is acceptable because predictions are small, and cheap to read
    /// compared with making them. Returns `None` if the scene is not published.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if another task has published it; [`StorageError::Damaged`] if an
    /// object is missing or changed ([`Self::restore`] repairs it); [`StorageError::Store`].
    pub async fn finished(
        &self,
        scene: u64,
        task_key: &str,
    ) -> Result<Option<PredictionManifest>, StorageError> {
        let manifest = match self.manifest(scene).await {
            Ok(manifest) => manifest,
            Err(StorageError::NotPublished { .. }) => return Ok(None),
            Err(error) => return Err(error),
        };
        self.check_owner(&manifest, task_key)?;
        let objects = manifest.objects.iter();
        let mut checks =
            stream::iter(objects.map(|o| self.check_hash(o))).buffer_unordered(CONCURRENCY);
        while checks.try_next().await?.is_some() {}
        drop(checks);
        Ok(Some(manifest))
    }

    /// Returns an error if another task has published these predictions.
    fn check_owner(&self, found: &PredictionManifest, task_key: &str) -> Result<(), StorageError> {
        if found.task_key == task_key {
            return Ok(());
        }
        let what = format!(
            "{} holds what other models predict of scene {}, or of another form of it (task key {}, this task's is \
             {task_key}); choose another folder",
            self.place(),
            found.scene,
            found.task_key
        );
        Err(StorageError::invalid("output.dataset", what))
    }

    async fn check_hash(&self, object: &ObjectEntry) -> Result<(), StorageError> {
        let path = self.path(&object.key);
        intact(&*self.store, &path, object).await.map(|_| ())
    }

    /// Encodes the predictions of the scene in `manifest`. The manifest's format, objects and
    /// checksum are set here.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the values do not match the group's arrays, or a depth is not
    /// finite; [`StorageError::SceneOutOfRange`].
    pub fn encode(
        &self,
        manifest: PredictionManifest,
        predicted: &Predicted,
    ) -> Result<EncodedPredictions, StorageError> {
        let scene = manifest.scene;
        if scene >= self.spec.scenes {
            return Err(StorageError::SceneOutOfRange {
                scene,
                scenes: self.spec.scenes,
            });
        }
        if let Some(at) = predicted.depth_m.iter().position(|z| !z.is_finite()) {
            let z = predicted.depth_m[at];
            let what = format!(
                "scene {scene}: expected finite depths, found {z} at pixel {at}; NaN stands for a scene that is not there"
            );
            return Err(StorageError::invalid("depth", what));
        }
        let (mut objects, mut bytes) = (Vec::new(), Vec::new());
        for plate in self.plates.iter() {
            let values: &[u8] = match plate.name {
                "depth" => bytemuck::cast_slice(&predicted.depth_m),
                "lit" => &predicted.lit,
                "confidence" => &predicted.confidence,
                _ => &predicted.specular,
            };
            if values.len() != plate.bytes() {
                let what = format!(
                    "{} bytes of values, expected {}",
                    values.len(),
                    plate.bytes()
                );
                return Err(StorageError::invalid(plate.name, what));
            }
            let coded = plate.codec.encode(values)?;
            objects.push(ObjectEntry {
                key: plate.key(scene),
                size: coded.len() as u64,
                sha256: sha256_hex(&coded),
            });
            bytes.push(Bytes::from(coded));
        }
        let manifest = PredictionManifest {
            format: FORMAT,
            objects,
            ..manifest
        };
        Ok(EncodedPredictions {
            manifest: manifest.sealed(),
            bytes,
        })
    }

    /// Publishes encoded predictions like [`picofarm_dataset::Dataset::publish_encoded`] publishes scenes.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object exists with different bytes;
    /// [`StorageError::Store`].
    pub async fn publish(&self, encoded: &EncodedPredictions) -> Result<(), StorageError> {
        let manifest = &encoded.manifest;
        let paths = manifest.objects.iter().map(|o| self.path(&o.key));
        let all: Vec<(Path, Bytes)> = paths.zip(encoded.bytes.iter().cloned()).collect();
        put_all(&*self.store, &all).await?;
        let path = self.path(&Manifest::key(manifest.scene));
        objects::create_or_match(&*self.store, &path, manifest.to_bytes().into()).await?;
        put_again(&*self.store, &all).await
    }

    /// Returns a hash that pins every byte of the depths of these scenes, in order, and the model
    /// that predicted them. `seen` contains the SHA-256 of the scenes' manifests
    /// ([`picofarm_dataset::Pinned::manifests`]), which the model's inputs must match. Objects are not
    /// checked.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there are no depths, or if they belong to another scene or to
    /// several models; [`StorageError::NotPublished`], [`StorageError::Damaged`],
    /// [`StorageError::Store`].
    pub async fn pin_depths(
        &self,
        scenes: &[u64],
        seen: &[[u8; 32]],
    ) -> Result<PinnedDepths, StorageError> {
        let invalid = |what: String| StorageError::invalid("predictions", what);
        if !self.spec.depth {
            return Err(invalid(format!(
                "{} holds no depths; give its infer stage a \"tof\" model, or name a demultiplex stage",
                self.place()
            )));
        }
        self.pin("tof", scenes, seen).await
    }

    /// Returns the predicted depth of a scene in metres, `[row][column]`, checked against its
    /// manifest.
    ///
    /// # Errors
    /// Those of [`Self::read`]; [`StorageError::Invalid`] if there are no depths.
    pub async fn read_depth(&self, scene: u64) -> Result<Vec<f32>, StorageError> {
        let Some(plate) = self.plates.iter().find(|plate| plate.name == "depth") else {
            let what = format!("{} holds no depths", self.place());
            return Err(StorageError::invalid("predictions", what));
        };
        let manifest = self.manifest(scene).await?;
        let values = self.values(plate, &manifest).await?;
        Ok(bytemuck::pod_collect_to_vec(&values))
    }

    /// Returns a scene's values of an array, checked against its manifest.
    async fn values(
        &self,
        plate: &Plate,
        manifest: &PredictionManifest,
    ) -> Result<Vec<u8>, StorageError> {
        let key = plate.key(manifest.scene);
        let path = self.path(&key);
        let bytes = objects::require(&*self.store, &path).await?;
        let hash = sha256_hex(&bytes);
        let stated = |o: &ObjectEntry| o.key == key && o.sha256 == hash;
        if !manifest.objects.iter().any(stated) {
            return Err(StorageError::Damaged {
                object: self.shown(&path),
                what: "its SHA-256 is not the manifest's".into(),
            });
        }
        plate.codec.decode(&bytes)
    }

    /// Returns the predictions of a scene, checked against its manifest.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Codec`],
    /// [`StorageError::Store`].
    pub async fn read(&self, scene: u64) -> Result<Predicted, StorageError> {
        let manifest = self.manifest(scene).await?;
        let mut predicted = Predicted::default();
        for plate in self.plates.iter() {
            let values = self.values(plate, &manifest).await?;
            match plate.name {
                "depth" => predicted.depth_m = bytemuck::pod_collect_to_vec(&values),
                "lit" => predicted.lit = values,
                "confidence" => predicted.confidence = values,
                _ => predicted.specular = values,
            }
        }
        Ok(predicted)
    }

    fn root(&self) -> Value {
        let arrays = self.plates.iter();
        let arrays: Map<String, Value> = arrays
            .map(|plate| (plate.name.to_owned(), plate.metadata(self.spec.scenes)))
            .collect();
        json!({
            "zarr_format": 3,
            "node_type": "group",
            "attributes": {
                "picofarm": {"predictions": FORMAT, "spec": self.spec},
                "made_of": "manifests/<scene>.json names the scene and the models",
            },
            "consolidated_metadata": {"kind": "inline", "must_understand": false, "metadata": arrays},
        })
    }

    fn metadata_path(&self, plate: &Plate) -> Path {
        self.path(&format!("{}/{METADATA}", plate.name))
    }

    fn path(&self, key: &str) -> Path {
        objects::path_of(&self.prefix, key)
    }

    fn shown(&self, path: &Path) -> String {
        objects::shown(&*self.store, path)
    }
}

/// Returns the first field that must be equal but differs, with both values.
fn difference(
    stored: &PredictionSpec,
    asked: &PredictionSpec,
) -> Option<(&'static str, String, String)> {
    let text = |value: &dyn std::fmt::Debug| format!("{value:?}");
    [
        ("height", text(&stored.height), text(&asked.height)),
        ("width", text(&stored.width), text(&asked.width)),
        ("depth", text(&stored.depth), text(&asked.depth)),
        ("spots", text(&stored.spots), text(&asked.spots)),
        ("specular", text(&stored.specular), text(&asked.specular)),
        (
            "confidence",
            text(&stored.confidence),
            text(&asked.confidence),
        ),
    ]
    .into_iter()
    .find(|(_, stored, asked)| stored != asked)
}

fn parse_root(bytes: &[u8], object: &str) -> Result<PredictionSpec, StorageError> {
    let root: Value = serde_json::from_slice(bytes).map_err(|e| StorageError::Damaged {
        object: object.to_owned(),
        what: format!("not JSON ({e}), so no Zarr group"),
    })?;
    let ours = &root["attributes"]["picofarm"];
    let other = |what: String| Err(StorageError::invalid(object, what));
    match ours["predictions"].as_u64() {
        Some(format) if format > u64::from(FORMAT) => other(format!(
            "written in format {format}, this program knows formats up to {FORMAT}: use a newer one"
        )),
        Some(_) => serde_json::from_value(ours["spec"].clone()).map_err(|e| StorageError::Damaged {
            object: object.to_owned(),
            what: format!("attributes.picofarm.spec: {e}"),
        }),
        None => other(
            "is a data set or another Zarr group, and not predictions; choose another folder for what models predict".into(),
        ),
    }
}
