//! Checking a whole data set and summing it up.

use std::collections::BTreeMap;
use std::fmt;

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;
use serde_json::Value;

use crate::dataset::{Dataset, METADATA};
use crate::error::DatasetError;
use crate::manifest::{Manifest, sha256_hex};
use crate::objects;
use crate::parts::part_scene;
use crate::spec::DatasetSpec;
use crate::splits;

/// Requests in flight.
const CONCURRENCY: usize = 16;

/// How thoroughly to check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VerifyMode {
    /// Metadata, manifests, and each object's presence and size.
    Fast,
    /// Also each object's SHA-256, and that it decodes.
    Full,
}

/// What is wrong with an object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// Its scene is published, but it is not there.
    Missing,
    /// Its size differs from the manifest's.
    WrongSize {
        /// The manifest's.
        expected: u64,
        /// The store's.
        found: u64,
    },
    /// Its SHA-256 differs from the manifest's.
    WrongHash {
        /// The manifest's.
        expected: String,
        /// That of the stored bytes.
        found: String,
    },
    /// It does not decode, or its content contradicts the manifest; the reason.
    Undecodable(String),
    /// Not the metadata the specification asks for; how they differ.
    BadMetadata(String),
    /// The manifest cannot be used; why.
    BadManifest(String),
    /// Nothing of this data set has this key.
    Foreign,
}

/// An object with a fault.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Full key.
    pub object: String,
    /// The scene it belongs to.
    pub scene: Option<u64>,
    /// The fault.
    pub fault: Fault,
}

/// What [`Dataset::verify`] found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verification {
    /// Published scenes.
    pub scenes: u64,
    /// Objects of published scenes that were checked.
    pub objects: u64,
    /// Their bytes.
    pub bytes: u64,
    /// What is wrong, ordered by key.
    pub problems: Vec<Problem>,
    /// Objects of scenes without a manifest: being written now, or left by a killed worker and adopted when the scene
    /// is published. Ordered by key.
    pub unpublished: Vec<String>,
}

impl Verification {
    /// Whether nothing is wrong.
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty()
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.object)?;
        match &self.fault {
            Fault::Missing => write!(f, "missing"),
            Fault::WrongSize { expected, found } => {
                write!(f, "expected {expected} bytes, found {found}")
            }
            Fault::WrongHash { expected, found } => {
                write!(f, "expected SHA-256 {expected}, found {found}")
            }
            Fault::Undecodable(why) => write!(f, "does not decode: {why}"),
            Fault::BadMetadata(why) => write!(f, "unusable metadata: {why}"),
            Fault::BadManifest(why) => write!(f, "unusable manifest: {why}"),
            Fault::Foreign => write!(f, "does not belong to this data set"),
        }
    }
}

/// A data set in numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Its properties; `spec.scenes` is the number of scenes there is room for.
    pub spec: DatasetSpec,
    /// Published scenes.
    pub scenes: u64,
    /// Bytes of their objects.
    pub bytes: u64,
    /// Largest coding error of any bin of any scene, in σ.
    pub max_sigma: f64,
    /// Smallest and largest root-mean-square coding error of a scene, in σ; `None` while nothing is published.
    pub rms_sigma: Option<(f64, f64)>,
    /// Saturated bins kept in overflow lists.
    pub overflow: u64,
    /// Median over the scenes of the Monte Carlo error that the renderer states (`error.median_relative` in the
    /// provenance's plan: median over pixels of standard error / h); `None` where no scene states one.
    pub noise: Option<f64>,
}

impl Dataset {
    /// Checks the data set and names each object that is broken, missing or foreign.
    ///
    /// # Errors
    /// [`DatasetError::Store`] where the store fails; faults of the data are in the report.
    pub async fn verify(&self, mode: VerifyMode) -> Result<Verification, DatasetError> {
        let mut listed = self.list_keys().await?;
        let mut report = Verification {
            scenes: 0,
            objects: 0,
            bytes: 0,
            problems: Vec::new(),
            unpublished: Vec::new(),
        };
        listed.retain(|key, _| !splits::is_split(key));
        self.verify_metadata(&mut listed, &mut report).await?;
        let mut scenes = Vec::new();
        listed.retain(|key, _| match manifest_scene(key) {
            Some(scene) => {
                scenes.push(scene);
                false
            }
            None => true,
        });
        report.scenes = scenes.len() as u64;
        let listed_ref = &listed;
        let checks: Vec<_> = scenes
            .into_iter()
            .map(|scene| self.verify_scene(scene, listed_ref, mode))
            .collect();
        let checked: Vec<CheckedScene> = stream::iter(checks)
            .buffer_unordered(match mode {
                VerifyMode::Fast => CONCURRENCY,
                // Whole scenes are in memory.
                VerifyMode::Full => 1,
            })
            .try_collect()
            .await?;
        for scene in checked {
            report.problems.extend(scene.problems);
            for (key, size) in scene.found {
                listed.remove(&key);
                report.objects += 1;
                report.bytes += size;
            }
        }
        for key in listed.into_keys() {
            let object = self.shown(&self.path(&key));
            match self.object_scene(&key) {
                Some(_) => report.unpublished.push(object),
                None => report.problems.push(Problem {
                    object,
                    scene: None,
                    fault: Fault::Foreign,
                }),
            }
        }
        report.problems.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(report)
    }

    /// Sums the data set up from its manifests.
    ///
    /// # Errors
    /// [`DatasetError::Damaged`] names an unusable manifest; [`DatasetError::Store`].
    pub async fn info(&self) -> Result<Summary, DatasetError> {
        let scenes = self.scenes_present().await?;
        let mut summary = Summary {
            spec: self.spec,
            scenes: scenes.len() as u64,
            bytes: 0,
            max_sigma: 0.0,
            rms_sigma: None,
            overflow: 0,
            noise: None,
        };
        let mut noise = Vec::new();
        let reads: Vec<_> = scenes
            .into_iter()
            .map(|scene| self.manifest(scene))
            .collect();
        let mut manifests = stream::iter(reads).buffer_unordered(CONCURRENCY);
        while let Some(manifest) = manifests.try_next().await? {
            summary.bytes += manifest.total_bytes();
            summary.overflow += manifest.overflow.len() as u64;
            summary.max_sigma = summary.max_sigma.max(manifest.error.max_sigma);
            for subset in manifest.subsets.values() {
                summary.overflow += subset.overflow.len() as u64;
                summary.max_sigma = summary.max_sigma.max(subset.error.max_sigma);
            }
            noise.extend(manifest.provenance.plan["error"]["median_relative"].as_f64());
            let rms = manifest.error.rms_sigma;
            let (low, high) = summary.rms_sigma.unwrap_or((rms, rms));
            summary.rms_sigma = Some((low.min(rms), high.max(rms)));
        }
        noise.sort_by(f64::total_cmp);
        summary.noise = noise.get(noise.len() / 2).copied();
        Ok(summary)
    }

    /// The key of a path below the prefix, relative to it.
    pub(crate) fn relative(&self, path: &Path) -> String {
        let parts = path.parts().skip(self.prefix.parts().count());
        let parts: Vec<String> = parts.map(|part| part.as_ref().to_string()).collect();
        parts.join("/")
    }

    /// Every key below the prefix, relative to it, with its size.
    async fn list_keys(&self) -> Result<BTreeMap<String, u64>, DatasetError> {
        self.store
            .list(Some(&self.prefix))
            .map_ok(|object| (self.relative(&object.location), object.size))
            .try_collect()
            .await
            .map_err(|e| DatasetError::store("list", self.shown(&self.prefix), e))
    }

    async fn verify_metadata(
        &self,
        listed: &mut BTreeMap<String, u64>,
        report: &mut Verification,
    ) -> Result<(), DatasetError> {
        let root = crate::dataset::root_metadata(&self.spec, self.format);
        let arrays = self.arrays.iter().map(|array| {
            let key = format!("{}/{METADATA}", array.layout.quantity.name());
            (key, array.layout.metadata(self.spec.scenes))
        });
        for (key, expected) in std::iter::once((METADATA.to_string(), root)).chain(arrays) {
            let path = self.path(&key);
            let fault = match objects::get(&*self.store, &path).await? {
                None => Some(Fault::Missing),
                Some(bytes) => metadata_fault(&bytes, &expected),
            };
            listed.remove(&key);
            report.problems.extend(fault.map(|fault| Problem {
                object: self.shown(&path),
                scene: None,
                fault,
            }));
        }
        Ok(())
    }

    async fn verify_scene(
        &self,
        scene: u64,
        listed: &BTreeMap<String, u64>,
        mode: VerifyMode,
    ) -> Result<CheckedScene, DatasetError> {
        let mut checked = CheckedScene {
            problems: Vec::new(),
            found: Vec::new(),
        };
        let path = self.path(&Manifest::key(scene));
        let problem = |object: String, fault| Problem {
            object,
            scene: Some(scene),
            fault,
        };
        let bytes = objects::require(&*self.store, &path).await?;
        let manifest = match self.usable_manifest(&bytes, scene, &self.shown(&path)) {
            Ok(manifest) => manifest,
            Err(why) => {
                checked
                    .problems
                    .push(problem(self.shown(&path), Fault::BadManifest(why)));
                return Ok(checked);
            }
        };
        for object in &manifest.objects {
            let path = self.path(&object.key);
            let fault = match listed.get(&object.key) {
                None => Some(Fault::Missing),
                Some(found) => {
                    checked.found.push((object.key.clone(), *found));
                    if *found != object.size {
                        Some(Fault::WrongSize {
                            expected: object.size,
                            found: *found,
                        })
                    } else if mode == VerifyMode::Full {
                        match objects::get(&*self.store, &path).await? {
                            None => Some(Fault::Missing),
                            Some(bytes) => self.content_fault(&manifest, object, bytes),
                        }
                    } else {
                        None
                    }
                }
            };
            let fault = fault.map(|fault| problem(self.shown(&path), fault));
            checked.problems.extend(fault);
        }
        Ok(checked)
    }

    /// The manifest, if it is of this data set and lists exactly the scene's objects.
    fn usable_manifest(&self, bytes: &[u8], scene: u64, object: &str) -> Result<Manifest, String> {
        let manifest = match Manifest::parse(bytes, scene, object) {
            Ok(manifest) => manifest,
            Err(DatasetError::Damaged { what, .. }) => return Err(what),
            Err(e) => return Err(e.to_string()),
        };
        if scene >= self.spec.scenes {
            return Err(format!(
                "the data set has room for {} scenes",
                self.spec.scenes
            ));
        }
        if manifest.profile != self.spec.profile {
            return Err("its codec profile is not the data set's".into());
        }
        let keys = self.arrays.iter().map(|array| array.layout.key(scene));
        if !keys.eq(manifest.objects.iter().map(|o| o.key.clone())) {
            return Err("it does not list exactly the scene's objects".into());
        }
        Ok(manifest)
    }

    fn content_fault(
        &self,
        manifest: &Manifest,
        object: &crate::ObjectEntry,
        bytes: Bytes,
    ) -> Option<Fault> {
        let found = sha256_hex(&bytes);
        if found != object.sha256 {
            return Some(Fault::WrongHash {
                expected: object.sha256.clone(),
                found,
            });
        }
        let array = self
            .arrays
            .iter()
            .find(|a| a.layout.key(manifest.scene) == object.key)?;
        let decoded = match array.layout.quantity {
            q if q.is_transient() => self.decode_shard(manifest, array, &bytes).map(drop),
            _ => array.codec.decode(&bytes).map(drop),
        };
        decoded.err().map(|e| Fault::Undecodable(e.to_string()))
    }

    /// The scene whose object has this key.
    pub(crate) fn object_scene(&self, key: &str) -> Option<u64> {
        if let Some(scene) = part_scene(key) {
            return Some(scene);
        }
        let mut parts = key.split('/');
        let name = parts.next()?;
        let scene: u64 = parts.nth(1)?.parse().ok()?;
        let array = self
            .arrays
            .iter()
            .find(|a| a.layout.quantity.name() == name)?;
        (scene < self.spec.scenes && array.layout.key(scene) == key).then_some(scene)
    }
}

struct CheckedScene {
    problems: Vec<Problem>,
    /// Objects found, with their sizes.
    found: Vec<(String, u64)>,
}

pub(crate) fn manifest_scene(key: &str) -> Option<u64> {
    let scene = key
        .strip_prefix("manifests/")?
        .strip_suffix(".json")?
        .parse()
        .ok()?;
    (Manifest::key(scene) == key).then_some(scene)
}

fn metadata_fault(bytes: &[u8], expected: &Value) -> Option<Fault> {
    let stored: Value = match serde_json::from_slice(bytes) {
        Ok(stored) => stored,
        Err(e) => return Some(Fault::BadMetadata(format!("not JSON: {e}"))),
    };
    let member = |value: &Value| value.as_object().cloned().unwrap_or_default();
    let (stored, expected) = (member(&stored), member(expected));
    let differing: Vec<&str> = expected
        .iter()
        .filter(|(key, value)| stored.get(*key) != Some(*value))
        .map(|(key, _)| key.as_str())
        .collect();
    (!differing.is_empty()).then(|| {
        Fault::BadMetadata(format!(
            "not what the data set's specification gives: {}",
            differing.join(", ")
        ))
    })
}
