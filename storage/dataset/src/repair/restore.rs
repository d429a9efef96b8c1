//! Restores broken objects of a published scene from the regenerated scene.
//!
//! Only this code overwrites a scene's objects. It writes nothing unless the regenerated scene is
//! proved to equal the original. The proof is the manifest, if its checksum shows that it is
//! intact. If the manifest itself is broken, the proof is a snapshot with its SHA-256, or the
//! remaining objects, which must all be equal.

use futures::{StreamExt, TryStreamExt, stream};

use crate::layout::group::{METADATA, pretty};
use crate::layout::manifest::Manifest;
use crate::layout::quantity::Quantity;
use crate::scenes::dataset::Dataset;
use crate::scenes::encode::EncodedScene;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::sha256_hex;

/// Number of objects checked concurrently.
const CONCURRENCY: usize = 4;

/// The result of [`Dataset::restore`].
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Restored {
    /// Full keys of the objects written, in the manifest's order, with the manifest last.
    pub written: Vec<String>,
    /// SHA-256 of the scene's manifest, in hexadecimal.
    pub manifest_sha256: String,
}

/// The result of comparing a stored object.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Found {
    Missing,
    Equal,
    Other,
}

impl Dataset {
    /// Writes the regenerated objects of a scene that are missing or broken, each in one atomic
    /// put, and the manifest last. Other objects are not touched. `witness` is the SHA-256 (in
    /// hexadecimal) of the scene's manifest in a snapshot.
    ///
    /// # Errors
    /// [`StorageError::Diverged`], an alarm, if the scene differs from the manifest (or the
    /// snapshot); nothing was written. [`StorageError::Damaged`] if the manifest is broken and
    /// nothing proves that this is the same scene. [`StorageError::Store`].
    pub async fn restore(
        &self,
        scene: EncodedScene,
        witness: Option<&str>,
    ) -> Result<Restored, StorageError> {
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
                Ok::<_, StorageError>(match stored {
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

    /// Overwrites differing or missing metadata of arrays according to the root's specification.
    /// Returns the full keys written.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if the root contradicts itself, so that it cannot be relied on:
    /// see [`restore_root`](crate::restore_root); [`StorageError::Store`].
    pub async fn restore_metadata(&self) -> Result<Vec<String>, StorageError> {
        if !self.root_agrees().await? {
            return Err(StorageError::Damaged {
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

    /// Returns the stored manifest, if it can be relied on.
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
        // A manifest without a checksum proves nothing, unless it is equal to the regenerated one.
        let usable = self.usable_manifest(bytes, ours.scene, &object).ok();
        usable.filter(|m| m.checksum.is_some() || witness.is_some() || m.same_as(ours))
    }

    /// Checks that the regenerated objects match the manifest.
    fn check_equal(&self, stored: &Manifest, ours: &Manifest) -> Result<(), StorageError> {
        for (stored, ours) in stored.objects.iter().zip(&ours.objects) {
            if stored.sha256 != ours.sha256 {
                return Err(StorageError::Diverged {
                    object: self.shown(&self.path(&stored.key)),
                    expected: stored.sha256.clone(),
                    ours: ours.sha256.clone(),
                });
            }
        }
        Ok(())
    }

    /// Without a manifest, checks that the histogram exists, and that all existing objects are
    /// equal.
    fn check_alike(&self, ours: &Manifest, found: &[Found]) -> Result<(), StorageError> {
        let transient = self.array(Quantity::Transient).layout.key(ours.scene);
        for (object, found) in ours.objects.iter().zip(found) {
            let what = match found {
                Found::Other => "it is not what the scene comes out as now",
                Found::Missing if object.key == transient => "it is missing",
                _ => continue,
            };
            return Err(StorageError::Damaged {
                object: self.shown(&self.path(&object.key)),
                what: format!(
                    "{what}, and the scene's manifest is broken or missing too, so that nothing proves what the scene \
                     was; nothing was written (a snapshot would prove it)"
                ),
            });
        }
        Ok(())
    }

    /// Overwrites an object with one atomic put, and reads it back.
    pub(crate) async fn replace(
        &self,
        path: &object_store::path::Path,
        bytes: bytes::Bytes,
    ) -> Result<(), StorageError> {
        objects::overwrite(&*self.store, path, bytes.clone()).await?;
        match objects::get(&*self.store, path).await? {
            Some(stored) if stored == bytes => Ok(()),
            _ => Err(StorageError::Damaged {
                object: self.shown(path),
                what: "it was written again, but does not read back as written; check the store"
                    .into(),
            }),
        }
    }
}

/// Returns the manifest's bytes: in the current form, or in the older form if this matches the
/// witness.
fn as_witnessed(manifest: &Manifest, witness: Option<&str>) -> Result<Vec<u8>, StorageError> {
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
    found.ok_or_else(|| StorageError::Diverged {
        object: Manifest::key(manifest.scene),
        expected: witness.to_owned(),
        ours,
    })
}
