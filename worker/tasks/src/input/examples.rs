//! The scenes of a data set as training examples: a histogram and the ground truth of its spots.

use std::{
    collections::{HashMap, HashSet},
    sync::{Arc, Mutex},
};

use picofarm_dataset::{Dataset, Quantity};
use picofarm_model::{
    Random,
    scene::{Order, Scene, Scenes, Unreadable},
};
use picofarm_proto::spec::Histogram;
use picofarm_results::Predictions;
use picofarm_sensor::{Multiplex, PS_PER_M, Sensing, Sensor, SensorError};
use picofarm_store::StorageError;
use tokio::runtime::Handle;

use crate::{input::quantity, stores::Stores, task::TaskError};

#[cfg(test)]
mod folded;

/// A cache of scenes may use 1/`KEPT_SHARE` of a task's spare memory. Training and validation
/// scenes have one cache each.
const KEPT_SHARE: u64 = 6;

/// Maximum number of histogram buffers that are kept for reuse.
const SPARE: usize = 4;

/// Stream number of the sensor's noise among the random streams of a training.
const SENSED: u64 = 5;
/// Draw of scenes that look the same at every visit. No training visits a scene this often.
const ALWAYS: u64 = u64::MAX;

/// Scenes of a data set, in a fixed order.
pub(crate) struct Examples {
    dataset: Dataset,
    runtime: Handle,
    quantity: Quantity,
    /// The spots that contribute to the histogram; `None` = all.
    spots: Option<Vec<u32>>,
    scenes: Vec<u64>,
    /// The sensor that histograms pass through, and the seed of its noise.
    sensor: Option<(Sensing, u64)>,
    /// Predicted depths that two-bounce times are derived from; `None` = the true depths.
    depths: Option<Predictions>,
    /// Predictions whose evidence is read, and no histograms.
    evidence: Option<Predictions>,
    /// Whether histograms are read although the network sees evidence.
    light: bool,
    kept: Mutex<LoadedScenes>,
    /// Scenes with checked histograms: these contain light and only finite numbers.
    sound: Mutex<HashSet<u64>>,
    /// Histogram buffers for reuse, because allocating new memory for each would cost as much as
    /// decoding it.
    spare: Mutex<Vec<Vec<f32>>>,
    /// The peak of each scene, from which the sensor's scale follows. It is the same at each visit.
    peaks: Mutex<HashMap<usize, f64>>,
}

/// Cache of scenes, filled until its memory is used up. Scenes are never replaced: a training
/// visits them in random order, so no other choice would be better than the first ones.
#[derive(Default)]
struct LoadedScenes {
    scenes: HashMap<usize, Arc<Scene>>,
    /// Remaining memory, in bytes.
    room: usize,
}

impl LoadedScenes {
    fn keep(&mut self, index: usize, scene: &Arc<Scene>) {
        let bytes = scene.bytes();
        // Reserves memory for the spare buffers too.
        if bytes.saturating_mul(1 + SPARE) <= self.room
            && self.scenes.insert(index, scene.clone()).is_none()
        {
            self.room -= bytes;
        }
    }
}

impl Examples {
    /// Creates examples from the given scenes, with one of the data set's histograms and true
    /// two-bounce times.
    ///
    /// # Errors
    /// [`TaskError::User`] naming the field below `of` if the data set has no such histogram or
    /// spot.
    pub(crate) fn new(
        stores: &Stores,
        dataset: &Dataset,
        (histogram, spots): (Histogram, &[u32]),
        scenes: Vec<u64>,
        of: &str,
    ) -> Result<Self, TaskError> {
        let quantity = quantity(histogram);
        let spec = dataset.spec();
        if !spec.quantities().contains(&quantity) {
            let there = spec.quantities().into_iter();
            let there: Vec<&str> = there
                .filter(|q| q.is_transient())
                .map(Quantity::name)
                .collect();
            return Err(TaskError::User(format!(
                "{of}.histogram: {} has no {}; it has {}",
                dataset.place(),
                quantity.name(),
                there.join(", ")
            )));
        }
        if let Some(spot) = spots.iter().find(|s| **s >= spec.spots) {
            return Err(TaskError::User(format!(
                "{of}.spots: {spot}: {} has {} spots, counted from 0",
                dataset.place(),
                spec.spots
            )));
        }
        Ok(Self {
            dataset: dataset.clone(),
            runtime: stores.runtime().clone(),
            quantity,
            spots: match histogram {
                Histogram::Transient => None,
                Histogram::TransientSpots => Some(spots.to_vec()),
                _ => Some(quantity.spots_of_100().to_vec()),
            },
            scenes,
            sensor: None,
            depths: None,
            evidence: None,
            light: false,
            kept: Mutex::default(),
            sound: Mutex::default(),
            spare: Mutex::default(),
            peaks: Mutex::default(),
        })
    }

    /// Sets the size of the cache to a share of the memory left to the task (`left_mib`, MiB). If
    /// that memory is unknown, nothing is cached.
    #[must_use]
    pub(crate) fn staying(self, left_mib: Option<u64>) -> Self {
        let bytes = (left_mib.unwrap_or(0) << 20) / KEPT_SHARE;
        let kept = Mutex::new(LoadedScenes {
            scenes: HashMap::new(),
            room: usize::try_from(bytes).unwrap_or(usize::MAX),
        });
        Self { kept, ..self }
    }

    /// Derives two-bounce times from these depths, or from the true depths if `None`.
    #[must_use]
    pub(crate) fn timed_by(self, depths: Option<Predictions>) -> Self {
        Self { depths, ..self }
    }

    /// Reads the evidence of these predictions, and no histograms, if there are any.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` if the evidence is of other spots.
    pub(crate) fn seeing(
        self,
        evidence: Option<Predictions>,
        field: &str,
    ) -> Result<Self, TaskError> {
        if let Some(predictions) = &evidence {
            let (theirs, ours) = (&predictions.spec().spots, self.spot_numbers());
            if *theirs != ours {
                return Err(TaskError::User(format!(
                    "{field}: {} has evidence of {} spots, but the histogram {:?} has the light of {}; give \
                     demultiplex.histogram and the network's histogram the same spots",
                    predictions.place(),
                    theirs.len(),
                    self.quantity.name(),
                    ours.len()
                )));
            }
        }
        Ok(Self { evidence, ..self })
    }

    /// Reads histograms even if the network sees evidence, for pictures.
    #[must_use]
    pub(crate) fn with_light(self) -> Self {
        Self {
            light: true,
            ..self
        }
    }

    /// Passes histograms through a sensor with a noise seed.
    ///
    /// # Errors
    /// [`TaskError::User`] naming the sensor's invalid field.
    pub(crate) fn through(self, sensor: Option<(Sensor, u64)>) -> Result<Self, TaskError> {
        let gate = &self.dataset.spec().gate;
        let sensing = |(sensor, seed)| {
            let sensing = Sensing::new(sensor, gate.bins as usize, gate.bin_width_m * PS_PER_M)?;
            Ok((sensing, seed))
        };
        let sensor = sensor.map(sensing).transpose();
        let sensor = sensor.map_err(|SensorError::Invalid { field, what }| {
            TaskError::User(format!("train.{field}: {what}"))
        })?;
        Ok(Self { sensor, ..self })
    }

    /// Returns the number of spots that contribute to the histogram.
    pub(crate) fn spots(&self) -> usize {
        let all = self.dataset.spec().spots as usize;
        self.spots.as_ref().map_or(all, Vec::len)
    }

    /// Returns the indices of these spots in the data set.
    pub(crate) fn spot_numbers(&self) -> Vec<u32> {
        let all = || (0..self.dataset.spec().spots).collect();
        self.spots.clone().unwrap_or_else(all)
    }

    /// Returns a scene as it is stored.
    fn stored(&self, index: usize) -> Result<Arc<Scene>, Unreadable> {
        let kept = || self.kept.lock().expect("no panic while locked");
        if let Some(scene) = kept().scenes.get(&index) {
            return Ok(scene.clone());
        }
        let scene = Arc::new(self.runtime.block_on(self.scene(self.scenes[index]))?);
        kept().keep(index, &scene);
        Ok(scene)
    }

    /// Returns a scene through the sensor, if there is one. `draw` selects the draw of its noise.
    fn sensed(&self, index: usize, draw: u64) -> Result<Arc<Scene>, Unreadable> {
        let stored = self.stored(index)?;
        let Some((sensor, seed)) = &self.sensor else {
            return Ok(stored);
        };
        let seed = Random::new(*seed, &[SENSED, draw]).bits();
        let peaks = || self.peaks.lock().expect("no panic while locked");
        let known = peaks().get(&index).copied();
        let mut seen = self.room();
        let of = (seed, self.scenes[index]);
        let peak = sensor.radiance(&stored.histogram, of, known, &mut seen);
        let peak = peak.map_err(
            |SensorError::Invalid { field, what }| StorageError::Invalid {
                field: format!("train.{field}"),
                what: format!("scene {}: {what}", self.scenes[index]),
            },
        )?;
        if let Some(found) = peak.filter(|_| known.is_none()) {
            peaks().insert(index, found);
        }
        Ok(Arc::new(stored.showing(seen)))
    }

    /// Takes a spare histogram buffer, or an empty one if there is none.
    fn room(&self) -> Vec<f32> {
        let mut spare = self.spare.lock().expect("no panic while locked");
        spare.pop().unwrap_or_default()
    }

    /// Reads a scene's histogram and its element order, in the order that networks expect if there
    /// is no sensor.
    async fn histogram(&self, scene: u64) -> Result<(Vec<f32>, Order), StorageError> {
        if self.evidence.is_some() && !self.light {
            return Ok((Vec::new(), Order::default()));
        }
        let Some(spots) = self
            .spots
            .as_ref()
            .filter(|_| self.quantity == Quantity::TransientSpots)
        else {
            let mut h = self.room();
            let (dataset, quantity) = (&self.dataset, self.quantity);
            let order = match self.sensor {
                None => {
                    dataset.read_planes_into(scene, quantity, &mut h).await?;
                    Order::Bins
                }
                Some(_) => {
                    dataset.read_histogram_into(scene, quantity, &mut h).await?;
                    Order::Pixels
                }
            };
            return Ok((h, order));
        };
        let mut sum = Multiplex::new(self.dataset.spec().transient_len());
        for spot in spots {
            let h = self.dataset.read_spot(scene, *spot).await?;
            sum.add(&h).expect("each spot's histogram has that length");
        }
        Ok((sum.finish(), Order::Pixels))
    }

    async fn scene(&self, scene: u64) -> Result<Scene, StorageError> {
        let dataset = &self.dataset;
        let spec = dataset.spec();
        let seen = async {
            match &self.depths {
                Some(depths) => depths.read_depth(scene).await.map(Some),
                None => Ok(None),
            }
        };
        let evidence = async {
            match &self.evidence {
                Some(evidence) => evidence.read_evidence(scene).await,
                None => Ok(Vec::new()),
            }
        };
        let ((histogram, order), seen_depth_m, evidence, depth, specular, lit, spots, intrinsics) =
            futures::try_join!(
                self.histogram(scene),
                seen,
                evidence,
                dataset.read::<f32>(scene, Quantity::Depth),
                dataset.read::<u8>(scene, Quantity::Specular),
                dataset.read_visibility(scene),
                dataset.read_spots(scene),
                dataset.read_intrinsics(scene),
            )?;
        // A sound histogram is not checked again at each visit.
        let sound = || self.sound.lock().expect("no panic while locked");
        if !histogram.is_empty() && !sound().contains(&scene) {
            check_light(&dataset.place(), scene, &histogram)?;
            sound().insert(scene);
        }
        // Pixels without a depth are set to infinity, because zero would be at the camera.
        let depth_m: Vec<f32> = depth
            .into_iter()
            .map(|z| if z > 0.0 { z } else { f32::INFINITY })
            .collect();
        let pixels = spec.pixels();
        let (spots, lit) = match &self.spots {
            None => (spots, lit),
            Some(chosen) => {
                let of = |spot: &u32| &lit[*spot as usize * pixels..][..pixels];
                let lit = chosen.iter().flat_map(of).copied().collect();
                (chosen.iter().map(|s| spots[*s as usize]).collect(), lit)
            }
        };
        let intrinsics = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy];
        Ok(Scene {
            height: spec.height as usize,
            width: spec.width as usize,
            bins: spec.gate.bins as usize,
            histogram,
            order,
            first_m: spec.gate.start_m,
            bin_width_m: spec.gate.bin_width_m,
            depth_m,
            seen_depth_m,
            evidence,
            specular,
            spots: spots
                .iter()
                .map(|spot| spot.map_or([f32::NAN; 3], |s| s.position))
                .collect(),
            beams_m: spots
                .iter()
                .map(|spot| spot.map_or(f32::NAN, |s| s.path_m))
                .collect(),
            lit,
            intrinsics: intrinsics.map(f64::from),
        })
    }
}

impl Scenes for Examples {
    fn len(&self) -> usize {
        self.scenes.len()
    }

    fn load(&self, index: usize) -> Result<Arc<Scene>, Unreadable> {
        self.sensed(index, ALWAYS)
    }

    fn take_back(&self, scene: Arc<Scene>) {
        if let Some(scene) = Arc::into_inner(scene) {
            let room = self.kept.lock().expect("no panic while locked").room;
            let mut spare = self.spare.lock().expect("no panic while locked");
            let bytes = 4 * scene.histogram.len();
            if spare.len() < SPARE && bytes.saturating_mul(spare.len() + 1) <= room {
                spare.push(scene.histogram);
            }
        }
    }

    fn visited(&self, index: usize, visit: u64) -> Result<Arc<Scene>, Unreadable> {
        self.sensed(index, visit)
    }
}

/// Rejects a histogram that has no light or contains numbers that are not finite, because a network
/// would take both for measurements.
fn check_light(place: &str, scene: u64, histogram: &[f32]) -> Result<(), StorageError> {
    let odd = histogram.iter().find(|h| !(h.is_finite() && **h >= 0.0));
    let what = match odd {
        Some(odd) => format!(
            "a bin of scene {scene}'s histogram is {odd}; expected finite numbers of at least 0"
        ),
        None if histogram.iter().all(|h| *h == 0.0) => {
            format!("every bin of scene {scene}'s histogram is 0: no light arrives within the gate")
        }
        None => return Ok(()),
    };
    Err(StorageError::Invalid {
        field: "source".into(),
        what: format!("{place}: {what}; render or import the scene again"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_without_light_or_with_what_is_no_number_is_refused_by_its_scene() {
        assert!(check_light("a/b", 7, &[0.0, 1e-30, 2.0]).is_ok());
        let said = |h: &[f32]| check_light("a/b", 7, h).unwrap_err().to_string();
        assert!(said(&[0.0; 4]).contains("a/b: every bin of scene 7's histogram is 0"));
        for odd in [f32::NAN, f32::INFINITY, -1.0] {
            let said = said(&[1.0, odd]);
            assert!(
                said.contains(&format!("is {odd}; expected finite")),
                "{said}"
            );
        }
    }
}
