//! Scenes derived from other scenes: another histogram with the same ground truth.

use std::collections::BTreeMap;

use crate::layout::quantity::Quantity;
use crate::layout::record::{Intrinsics, Provenance, Spot, SubsetRecord};
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::Dataset;
use crate::scenes::encode::{Content, EncodedScene, assemble, intensity};
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::sha256_hex;

/// All of a published scene except histograms and data computed from them: depth, range, normals,
/// instances, labels, specular, visibility, two-bounce paths, RGB, spots, intrinsics, pose and
/// laser, as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneTruth {
    spec: DatasetSpec,
    /// Values of each quantity, in native byte order.
    arrays: BTreeMap<Quantity, Vec<u8>>,
}

impl Dataset {
    /// Reads the ground truth of a published scene, and checks each object against its manifest.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Codec`],
    /// [`StorageError::Store`].
    pub async fn read_truth(&self, scene: u64) -> Result<SceneTruth, StorageError> {
        let manifest = self.manifest(scene).await?;
        let mut arrays = BTreeMap::new();
        for array in self.arrays.iter().filter(|a| is_truth(a.layout.quantity)) {
            let key = array.layout.key(scene);
            let path = self.path(&key);
            let bytes = objects::require(&*self.store, &path).await?;
            if manifest.object(&key).map(|o| &o.sha256) != Some(&sha256_hex(&bytes)) {
                return Err(StorageError::Damaged {
                    object: self.shown(&path),
                    what: "its SHA-256 is not the manifest's".into(),
                });
            }
            arrays.insert(array.layout.quantity, array.codec.decode(&bytes)?);
        }
        Ok(SceneTruth {
            spec: self.spec,
            arrays,
        })
    }

    /// Encodes a scene with the given histogram (`[row][column][bin]` of this data set's gate) and
    /// photon scale, and the ground truth of another data set's scene. Blocks its thread while
    /// rayon threads encode.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if this data set has another image size, other spots or additional
    /// transients, or if a value is unusable; [`StorageError::SceneOutOfRange`].
    pub fn encode_derived(
        &self,
        scene: u64,
        truth: &SceneTruth,
        transient: &[f32],
        scale: f32,
        provenance: &Provenance,
    ) -> Result<EncodedScene, StorageError> {
        self.encode_derived_with(scene, truth, (transient, &[]), scale, provenance)
    }

    /// Encodes the same with the histograms of each spot alone, if this data set has them, after
    /// that of all spots.
    ///
    /// # Errors
    /// Those of [`Self::encode_derived`]; [`StorageError::Invalid`] if histograms of single spots
    /// are missing, or have another size.
    pub fn encode_derived_with(
        &self,
        scene: u64,
        truth: &SceneTruth,
        (transient, spots): (&[f32], &[&[f32]]),
        scale: f32,
        provenance: &Provenance,
    ) -> Result<EncodedScene, StorageError> {
        self.check_scene(scene)?;
        let spec = &self.spec;
        let (ours, theirs) = (
            [spec.height, spec.width, spec.spots],
            [truth.spec.height, truth.spec.width, truth.spec.spots],
        );
        if ours != theirs {
            let what = format!(
                "expected {ours:?} rows, columns and spots as in the data set, found {theirs:?}"
            );
            return Err(StorageError::invalid("truth", what));
        }
        let other = |q: &Quantity| {
            q.is_transient() && !matches!(q, Quantity::Transient | Quantity::TransientSpots)
        };
        if spec.quantities().iter().any(other) {
            let what = "a derived data set has the histograms of all spots and of each; found subsets of spots too";
            return Err(StorageError::invalid("spec.subsets", what));
        }
        let planes = if spec.per_spot { spec.spots } else { 0 };
        if spots.len() != planes as usize || spots.iter().any(|h| h.len() != spec.transient_len()) {
            let what = format!(
                "expected {planes} histograms of {} values, found {}",
                spec.transient_len(),
                spots.len()
            );
            return Err(StorageError::invalid("transient_spots", what));
        }
        if spec.two_bounce != truth.spec.two_bounce {
            let what = "one of both has two-bounce paths, the other has not";
            return Err(StorageError::invalid("spec.two_bounce", what));
        }
        if transient.len() != spec.transient_len() {
            let (expected, found) = (spec.transient_len(), transient.len());
            let what = format!("expected {expected} values, found {found}");
            return Err(StorageError::invalid("transient", what));
        }
        if !(scale.is_normal() && scale > 0.0) {
            let what = format!("expected a positive finite number, found {scale}");
            return Err(StorageError::invalid("scale", what));
        }
        let subset = SubsetRecord {
            quantity: Quantity::TransientSpots,
            planes: spots.to_vec(),
        };
        let content = Content {
            transient,
            subsets: std::slice::from_ref(&subset),
            scale,
        };
        assemble(self, scene, &content, provenance, |quantity| {
            Ok(match quantity {
                Quantity::Intensity => intensity(transient, spec.gate.bins),
                Quantity::Scale => scale.to_ne_bytes().to_vec(),
                truth_of => truth.arrays[&truth_of].clone(),
            })
        })
    }
}

impl SceneTruth {
    /// Returns the ground truth with another calibration: spots, intrinsics, and the laser in the
    /// camera's frame.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for another number of spots.
    pub fn calibrated(
        mut self,
        spots: &[Option<Spot>],
        intrinsics: Intrinsics,
        laser: [f32; 3],
    ) -> Result<Self, StorageError> {
        if spots.len() != self.spec.spots as usize {
            let what = format!("expected {} spots, found {}", self.spec.spots, spots.len());
            return Err(StorageError::invalid("spots", what));
        }
        let (i, mut put) = (intrinsics, |quantity, values: &[f32]| {
            let bytes = values.iter().flat_map(|x| x.to_ne_bytes()).collect();
            self.arrays.insert(quantity, bytes);
        });
        let row = |spot: &Option<Spot>| spot.map_or([f32::NAN; 7], |s| s.row());
        put(
            Quantity::Spots,
            &spots.iter().flat_map(row).collect::<Vec<f32>>(),
        );
        put(Quantity::Intrinsics, &[i.fx, i.fy, i.cx, i.cy]);
        put(Quantity::Laser, &laser);
        Ok(self)
    }

    /// Returns the ground truth with only the given spots, in the given order.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if a spot does not exist, or none is chosen.
    pub fn of_spots(mut self, chosen: &[u32]) -> Result<Self, StorageError> {
        let spots = self.spec.spots;
        if chosen.is_empty() || chosen.iter().any(|s| *s >= spots) {
            let what = format!(
                "expected some of the spots 0 to {}, found {chosen:?}",
                spots - 1
            );
            return Err(StorageError::invalid("spots", what));
        }
        let pixels = self.spec.pixels();
        let packed = &self.arrays[&Quantity::Visibility];
        let mut visibility = vec![0u8; chosen.len().div_ceil(8) * pixels];
        for (to, from) in chosen.iter().map(|s| *s as usize).enumerate() {
            let source = &packed[from / 8 * pixels..][..pixels];
            let target = &mut visibility[to / 8 * pixels..][..pixels];
            for (target, source) in target.iter_mut().zip(source) {
                *target |= (source >> (from % 8) & 1) << (to % 8);
            }
        }
        let rows: Vec<&[u8]> = self.arrays[&Quantity::Spots].chunks_exact(7 * 4).collect();
        let rows = chosen.iter().map(|s| rows[*s as usize]);
        let rows = rows.collect::<Vec<_>>().concat();
        if let Some(paths) = self.arrays.get_mut(&Quantity::TwoBouncePath) {
            let spots: Vec<&[u8]> = paths.chunks_exact(pixels * 4).collect();
            let kept: Vec<&[u8]> = chosen.iter().map(|s| spots[*s as usize]).collect();
            *paths = kept.concat();
        }
        self.arrays.insert(Quantity::Visibility, visibility);
        self.arrays.insert(Quantity::Spots, rows);
        self.spec.spots = chosen.len() as u32;
        Ok(self)
    }
}

fn is_truth(quantity: Quantity) -> bool {
    !quantity.is_transient() && !matches!(quantity, Quantity::Intensity | Quantity::Scale)
}
