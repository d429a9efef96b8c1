//! The scenes of a data set as networks meet them: a histogram, and the truth of the spots that made it.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
};

use picofarm_dataset::{Dataset, DatasetError, Quantity, SplitUsed, Spot, sha256_hex};
use picofarm_model::scene::{Scene, Scenes};
use picofarm_proto::{
    model::Histogram,
    split::{Rank, SplitRecord},
};
use picofarm_transient::sensor::Multiplex;
use tokio::runtime::Handle;

use super::{Control, TaskError, memory::memory_mib, output::Stores, reprocess::quantity};

/// A beam whose path from the laser is longer than the straight line by more than this, in metres, met a mirror.
const STRAIGHT_M: f32 = 1e-3;

/// One part of so many of the memory holds scenes; training and validation have one each.
const KEPT_SHARE: u64 = 6;

/// Scenes of a data set, in an order.
pub(super) struct Examples {
    dataset: Dataset,
    runtime: Handle,
    quantity: Quantity,
    /// The spots whose light the histogram holds; `None` = all.
    spots: Option<Vec<u32>>,
    scenes: Vec<u64>,
    kept: Mutex<Kept>,
}

/// Scenes that stay in memory, as many as there is room for. The order in which a training visits them is random, so that
/// no choice would be better than the first ones.
struct Kept {
    scenes: HashMap<usize, Arc<Scene>>,
    /// Bytes left.
    room: usize,
}

impl Kept {
    fn keep(&mut self, index: usize, scene: &Arc<Scene>) {
        let values = scene.histogram.len() + scene.depth_m.len() + scene.tof_m.len();
        let bytes = 4 * values + scene.specular.len() + scene.lit.len();
        if bytes <= self.room && self.scenes.insert(index, scene.clone()).is_none() {
            self.room -= bytes;
        }
    }
}

/// The sides of a split that were asked for, each in the split's order.
pub(super) struct Sides<const N: usize> {
    pub(super) split: SplitUsed,
    pub(super) scenes: [Vec<u64>; N],
}

impl Examples {
    /// The given scenes with one of the data set's histograms.
    ///
    /// # Errors
    /// [`TaskError::User`] naming the field below `of`, where the data set has no such histogram or spot.
    pub(super) fn new(
        stores: &Stores,
        dataset: &Dataset,
        (histogram, spots): (Histogram, &[u32]),
        scenes: Vec<u64>,
        of: &str,
    ) -> Result<Arc<Self>, TaskError> {
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
        Ok(Arc::new(Self {
            dataset: dataset.clone(),
            runtime: stores.runtime().clone(),
            quantity,
            spots: match histogram {
                Histogram::Transient => None,
                Histogram::TransientSpots => Some(spots.to_vec()),
                _ => Some(quantity.spots_of_100().to_vec()),
            },
            scenes,
            kept: Mutex::new(Kept {
                scenes: HashMap::new(),
                room: (memory_mib() / KEPT_SHARE) as usize * (1 << 20),
            }),
        }))
    }

    /// Spots whose light the histogram holds.
    pub(super) fn spots(&self) -> usize {
        let all = self.dataset.spec().spots as usize;
        self.spots.as_ref().map_or(all, Vec::len)
    }

    /// Which of the data set's they are.
    pub(super) fn spot_numbers(&self) -> Vec<u32> {
        let all = || (0..self.dataset.spec().spots).collect();
        self.spots.clone().unwrap_or_else(all)
    }

    async fn histogram(&self, scene: u64) -> Result<Vec<f32>, DatasetError> {
        let Some(spots) = self
            .spots
            .as_ref()
            .filter(|_| self.quantity == Quantity::TransientSpots)
        else {
            return self.dataset.read_histogram(scene, self.quantity).await;
        };
        let mut sum = Multiplex::new(self.dataset.spec().transient_len());
        for spot in spots {
            let h = self.dataset.read_spot(scene, *spot).await?;
            sum.add(&h).expect("each spot's histogram has that length");
        }
        Ok(sum.finish())
    }

    async fn scene(&self, scene: u64) -> Result<Scene, DatasetError> {
        let dataset = &self.dataset;
        let spec = dataset.spec();
        let (histogram, depth, specular, lit, spots, intrinsics, laser) = futures::try_join!(
            self.histogram(scene),
            dataset.read::<f32>(scene, Quantity::Depth),
            dataset.read::<u8>(scene, Quantity::Specular),
            dataset.read_visibility(scene),
            dataset.read_spots(scene),
            dataset.read_intrinsics(scene),
            dataset.read::<f32>(scene, Quantity::Laser),
        )?;
        // Nothing is seen there: infinitely far, not at the camera.
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
        let laser = [laser[0], laser[1], laser[2]];
        let intrinsics = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy];
        let width = spec.width as usize;
        let tof_m = two_bounce_m(&spots, laser, &depth_m, width, intrinsics);
        Ok(Scene {
            height: spec.height as usize,
            width,
            bins: spec.gate.bins as usize,
            histogram,
            first_m: spec.gate.start_m,
            bin_width_m: spec.gate.bin_width_m,
            depth_m,
            specular,
            spots: spots
                .iter()
                .map(|spot| spot.map_or([f32::NAN; 3], |s| s.position))
                .collect(),
            lit,
            tof_m,
            intrinsics: intrinsics.map(f64::from),
            laser,
        })
    }
}

impl Scenes for Examples {
    fn len(&self) -> usize {
        self.scenes.len()
    }

    fn load(&self, index: usize) -> Result<Arc<Scene>, Box<dyn std::error::Error + Send + Sync>> {
        let kept = || self.kept.lock().expect("no panic while locked");
        if let Some(scene) = kept().scenes.get(&index) {
            return Ok(scene.clone());
        }
        let scene = Arc::new(self.runtime.block_on(self.scene(self.scenes[index]))?);
        kept().keep(index, &scene);
        Ok(scene)
    }
}

/// Path of two-bounce light, metres: `[spot][row][column]`. Empty where every beam goes straight to its spot, so that it
/// follows from spots and depth; NaN for a beam that meets nothing.
fn two_bounce_m(
    spots: &[Option<Spot>],
    laser: [f32; 3],
    depth_m: &[f32],
    width: usize,
    [fx, fy, cx, cy]: [f32; 4],
) -> Vec<f32> {
    let bent = |s: &Spot| (s.path_m - distance(s.position, laser)).abs() > STRAIGHT_M;
    if !spots.iter().flatten().any(bent) {
        return Vec::new();
    }
    let path = |spot: &Option<Spot>, pixel: usize| {
        let Some(spot) = spot else { return f32::NAN };
        let (row, column) = ((pixel / width) as f32, (pixel % width) as f32);
        let z = depth_m[pixel];
        let point = [(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z];
        spot.path_m + distance(spot.position, point) + distance(point, [0.0; 3])
    };
    let pixels = 0..depth_m.len();
    spots
        .iter()
        .flat_map(|spot| pixels.clone().map(move |pixel| path(spot, pixel)))
        .collect()
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let d = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt()
}

/// The scenes of the given sides of a split's newest version, in the order in which it was cut: the first so many are
/// always among the first more.
///
/// # Errors
/// [`TaskError::User`] at `field` where there is no such split.
pub(super) fn sides<const N: usize>(
    stores: &Stores,
    dataset: &Dataset,
    (field, name): (&str, &str),
    sides: [&str; N],
    control: &Control,
) -> Result<Sides<N>, TaskError> {
    let versions = stores.wait(control, dataset.split_versions(name))?;
    let Some(version) = versions.last() else {
        return Err(TaskError::User(format!(
            "{field}: {} has no split {name:?}; make it with a split stage or `picofarm dataset split`",
            dataset.place()
        )));
    };
    let bytes = stores.wait(control, dataset.read_split(name, *version))?;
    let record = SplitRecord::parse(&bytes).map_err(|what| {
        TaskError::User(format!("{}: {what}", dataset.split_place(name, *version)))
    })?;
    let seed = record.settings.seed;
    Ok(Sides {
        scenes: sides.map(|side| {
            let mut scenes = record.scenes(side);
            scenes.sort_by_cached_key(|scene| Rank::of(seed, *scene));
            scenes
        }),
        split: SplitUsed {
            name: name.to_owned(),
            version: *version,
            sha256: sha256_hex(&bytes),
        },
    })
}

/// Keeps the first `limit` scenes; 0 = all.
///
/// # Errors
/// [`TaskError::User`] at `field` where there are fewer, or none at all.
pub(super) fn first(scenes: &mut Vec<u64>, limit: u64, field: &str) -> Result<(), TaskError> {
    let there = scenes.len() as u64;
    if there == 0 || limit > there {
        return Err(TaskError::User(format!(
            "{field}: {limit} scenes are asked for (0 = all), but that side of the split has {there}"
        )));
    }
    if limit > 0 {
        scenes.truncate(limit as usize);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_bounce_times_are_told_where_a_beam_met_a_mirror() {
        let spot = |path_m| {
            Some(Spot {
                position: [0.0, 0.0, 3.0],
                normal: [0.0, 0.0, -1.0],
                path_m,
            })
        };
        let of = |spots: &[Option<Spot>]| {
            two_bounce_m(spots, [0.0; 3], &[1.0, 1.0], 2, [1.0, 1.0, 0.5, 0.5])
        };
        assert_eq!(of(&[spot(3.0), None]), Vec::<f32>::new());
        let told = of(&[spot(4.0), None]);
        assert_eq!(told.len(), 4);
        assert_eq!(told[0], 4.0 + 2.0 + 1.0);
        assert_eq!(told[1], 4.0 + 5.0f32.sqrt() + 2.0f32.sqrt());
        assert!(told[2].is_nan() && told[3].is_nan());
    }

    #[test]
    fn fewer_scenes_are_the_first_and_more_than_there_are_is_an_error() {
        let mut scenes = vec![5, 2, 9];
        first(&mut scenes, 0, "train.scenes").unwrap();
        first(&mut scenes, 2, "train.scenes").unwrap();
        assert_eq!(scenes, [5, 2]);
        let said = first(&mut scenes, 3, "train.scenes").unwrap_err();
        assert!(said.to_string().contains("train.scenes: 3"), "{said}");
        assert!(first(&mut Vec::new(), 0, "train.scenes").is_err());
    }
}
