//! Putting back what is broken of a published scene, from the scene made again.
//!
//! The only path on which an object of a scene is overwritten. Nothing is, unless what was made again is proved to be
//! what was there: by the manifest, whose checksum shows that it is intact; where the manifest itself is what is broken,
//! by a snapshot that names its SHA-256, or by the objects that are still there, each of which must be equal.

use futures::{StreamExt, TryStreamExt, stream};

use crate::error::DatasetError;
use crate::layout::group::{METADATA, pretty};
use crate::layout::manifest::{Manifest, sha256_hex};
use crate::layout::quantity::Quantity;
use crate::scenes::dataset::Dataset;
use crate::scenes::encode::EncodedScene;
use crate::store::objects;

/// Objects looked at a time.
const CONCURRENCY: usize = 4;

/// What [`Dataset::restore`] did.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Restored {
    /// Full keys of the objects that were written, in the manifest's order; the manifest last.
    pub written: Vec<String>,
    /// SHA-256 of the scene's manifest, hexadecimal.
    pub manifest_sha256: String,
}

/// How a stored object compares.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Found {
    Missing,
    Equal,
    Other,
}

impl Dataset {
    /// Writes those objects of a scene, made again, that are missing or broken, each in one atomic put, and the manifest
    /// last; leaves the others alone. `witness` is the SHA-256 (hexadecimal) of the scene's manifest in a snapshot.
    ///
    /// # Errors
    /// [`DatasetError::Diverged`] where the scene came out other than the manifest (or the snapshot) says: an alarm;
    /// nothing was written. [`DatasetError::Damaged`] where the manifest is broken and nothing proves that this is the
    /// same scene. [`DatasetError::Store`].
    pub async fn restore(
        &self,
        scene: EncodedScene,
        witness: Option<&str>,
    ) -> Result<Restored, DatasetError> {
        let EncodedScene { manifest, bytes } = scene;
        let path = self.path(&Manifest::key(manifest.scene));
        let stored = objects::get(&*self.store, &path).await?;
        let authority = self.authority(stored.as_deref(), &manifest, witness);
        if let Some(stored) = &authority {
            self.check_equal(stored, &manifest)?;
        }
        let manifest_bytes = match &authority {
            Some(_) => None,
            None => Some(as_witnessed(&manifest, witness)?),
        };
        let look = |at: usize| {
            let (path, ours) = (self.path(&manifest.objects[at].key), bytes[at].clone());
            async move {
                let stored = objects::get(&*self.store, &path).await?;
                Ok::<_, DatasetError>(match stored {
                    None => Found::Missing,
                    Some(stored) if stored == ours => Found::Equal,
                    Some(_) => Found::Other,
                })
            }
        };
        let looks: Vec<_> = (0..bytes.len()).map(look).collect();
        let found: Vec<Found> = stream::iter(looks)
            .buffered(CONCURRENCY)
            .try_collect()
            .await?;
        if authority.is_none() && witness.is_none() {
            self.check_alike(&manifest, &found)?;
        }
        let mut restored = Restored::default();
        for (at, found) in found.iter().enumerate() {
            if *found != Found::Equal {
                let path = self.path(&manifest.objects[at].key);
                self.replace(&path, bytes[at].clone()).await?;
                restored.written.push(self.shown(&path));
            }
        }
        restored.manifest_sha256 = match (manifest_bytes, stored) {
            (Some(bytes), _) => {
                let sha256 = sha256_hex(&bytes);
                self.replace(&path, bytes.into()).await?;
                restored.written.push(self.shown(&path));
                sha256
            }
            (None, stored) => sha256_hex(&stored.unwrap_or_default()),
        };
        Ok(restored)
    }

    /// Writes the arrays' metadata that the root's specification asks for over those that differ or are missing; gives
    /// their full keys.
    ///
    /// # Errors
    /// [`DatasetError::Damaged`] where the root contradicts itself, so that it cannot be relied on: see
    /// [`restore_root`](crate::restore_root); [`DatasetError::Store`].
    pub async fn restore_metadata(&self) -> Result<Vec<String>, DatasetError> {
        if !self.root_agrees().await? {
            return Err(DatasetError::Damaged {
                object: self.shown(&self.path(METADATA)),
                what: "contradicts itself; nothing was written".into(),
            });
        }
        let mut written = Vec::new();
        for (key, expected) in self.metadata() {
            let path = self.path(&key);
            let stored = objects::get(&*self.store, &path).await?;
            let stored = stored.and_then(|b| serde_json::from_slice(&b).ok());
            if stored.as_ref() != Some(&expected) {
                self.replace(&path, pretty(&expected)).await?;
                written.push(self.shown(&path));
            }
        }
        Ok(written)
    }

    /// The stored manifest, if it can be relied on.
    fn authority(
        &self,
        stored: Option<&[u8]>,
        ours: &Manifest,
        witness: Option<&str>,
    ) -> Option<Manifest> {
        let bytes = stored?;
        if witness.is_some_and(|witness| sha256_hex(bytes) != witness) {
            return None;
        }
        let object = self.shown(&self.path(&Manifest::key(ours.scene)));
        // One without a checksum proves nothing, unless it says the same.
        let usable = self.usable_manifest(bytes, ours.scene, &object).ok();
        usable.filter(|m| m.checksum.is_some() || witness.is_some() || m.same_as(ours))
    }

    /// What was made again is what the manifest names.
    fn check_equal(&self, stored: &Manifest, ours: &Manifest) -> Result<(), DatasetError> {
        for (stored, ours) in stored.objects.iter().zip(&ours.objects) {
            if stored.sha256 != ours.sha256 {
                return Err(DatasetError::Diverged {
                    object: self.shown(&self.path(&stored.key)),
                    expected: stored.sha256.clone(),
                    ours: ours.sha256.clone(),
                });
            }
        }
        Ok(())
    }

    /// Without a manifest: the histogram must be there, and whatever is there must be equal.
    fn check_alike(&self, ours: &Manifest, found: &[Found]) -> Result<(), DatasetError> {
        let transient = self.array(Quantity::Transient).layout.key(ours.scene);
        for (object, found) in ours.objects.iter().zip(found) {
            let what = match found {
                Found::Other => "it is not what the scene comes out as now",
                Found::Missing if object.key == transient => "it is missing",
                _ => continue,
            };
            return Err(DatasetError::Damaged {
                object: self.shown(&self.path(&object.key)),
                what: format!(
                    "{what}, and the scene's manifest is broken or missing too, so that nothing proves what the scene \
                     was; nothing was written (a snapshot would prove it)"
                ),
            });
        }
        Ok(())
    }

    /// One atomic put over whatever is there, read back.
    pub(crate) async fn replace(
        &self,
        path: &object_store::path::Path,
        bytes: bytes::Bytes,
    ) -> Result<(), DatasetError> {
        objects::overwrite(&*self.store, path, bytes.clone()).await?;
        match objects::get(&*self.store, path).await? {
            Some(stored) if stored == bytes => Ok(()),
            _ => Err(DatasetError::Damaged {
                object: self.shown(path),
                what: "it was written again, but does not read back as written; check the store"
                    .into(),
            }),
        }
    }
}

/// The manifest's bytes: as they are written now, or in the older form if that is what the witness saw.
fn as_witnessed(manifest: &Manifest, witness: Option<&str>) -> Result<Vec<u8>, DatasetError> {
    let now = manifest.to_bytes();
    let Some(witness) = witness else {
        return Ok(now);
    };
    let older = Manifest {
        checksum: None,
        ..manifest.clone()
    };
    let forms = [now, older.to_bytes()];
    let ours = sha256_hex(&forms[0]);
    let found = forms.into_iter().find(|form| sha256_hex(form) == witness);
    found.ok_or_else(|| DatasetError::Diverged {
        object: Manifest::key(manifest.scene),
        expected: witness.to_owned(),
        ours,
    })
}
