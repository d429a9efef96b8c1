//! A scene of a data set as a flash: its multiplexed histogram and calibration, in the scene's
//! coordinates.

use picofarm_dataset::{Dataset, Manifest, Quantity};
use picofarm_demultiplex::{Capture, Evidence, Place, Spot};
use picofarm_proto::spec::{
    Histogram,
    kinds::demultiplex::{Method, Places},
};
use picofarm_scene::{Camera, Intrinsics, Vec3};
use picofarm_settings::Gate;
use picofarm_store::StorageError;

use crate::{
    input::camera::Frame,
    stores::Stores,
    task::{Control, TaskError},
};

/// Widest bins from which the method finds depth, metres of path.
pub const WIDEST_BIN_M: f64 = 0.32;
/// Greatest difference between the path of a straight beam and the distance to its spot, as a share
/// of the path. A greater difference means that a mirror folds the beam.
const FOLDED: f32 = 1e-3;

/// One flash with its calibration.
#[derive(Debug)]
pub struct Flash {
    histogram: Vec<f32>,
    gate: Gate,
    camera: Camera,
    laser: Vec3,
    spots: Vec<Spot>,
    /// Index of each spot among those of the histogram: beams that hit nothing have none.
    which: Vec<usize>,
}

/// Returns the array of a histogram.
///
/// # Errors
/// [`TaskError::User`] if the data set has no such histogram.
pub(super) fn quantity(dataset: &Dataset, histogram: Histogram) -> Result<Quantity, TaskError> {
    let there: Vec<Quantity> = dataset
        .spec()
        .quantities()
        .into_iter()
        .filter(|q| q.is_transient() && *q != Quantity::TransientSpots)
        .collect();
    if let Some(found) = there.iter().find(|q| q.name() == histogram.name()) {
        return Ok(*found);
    }
    let names: Vec<&str> = there.iter().map(|q| q.name()).collect();
    Err(TaskError::User(format!(
        "demultiplex.histogram: {} has no {:?}; it has {}",
        dataset.place(),
        histogram.name(),
        names.join(", ")
    )))
}

/// Returns the array of a histogram for each spot.
///
/// # Errors
/// [`TaskError::User`] if the data set has none.
pub(super) fn separate_quantity(dataset: &Dataset, method: Method) -> Result<Quantity, TaskError> {
    match dataset.spec().per_spot {
        true => Ok(Quantity::TransientSpots),
        false => Err(TaskError::User(format!(
            "demultiplex.method: {} has no histogram of each spot alone, which {:?} reads; render it with per_spot = true, \
             or import it with captures = \"both\"",
            dataset.place(),
            method.name()
        ))),
    }
}

/// Returns the spots that contribute to a histogram.
pub(super) fn numbers(dataset: &Dataset, histogram: Quantity) -> Vec<u32> {
    match histogram {
        Quantity::Transient | Quantity::TransientSpots => (0..dataset.spec().spots).collect(),
        subset => subset.spots_of_100().to_vec(),
    }
}

/// Refuses bins from which no depth follows.
///
/// # Errors
/// [`TaskError::User`] with the widths.
pub(super) fn check_gate(dataset: &Dataset) -> Result<(), TaskError> {
    let gate = dataset.spec().gate;
    if gate.bin_width_m <= WIDEST_BIN_M {
        return Ok(());
    }
    Err(TaskError::User(format!(
        "source: the bins of {} are {} m wide, and the method needs at most {WIDEST_BIN_M} m to tell the spots apart; render \
         with a smaller bin_width_m",
        dataset.place(),
        gate.bin_width_m
    )))
}

impl Flash {
    /// Reads a scene.
    ///
    /// # Errors
    /// [`TaskError::User`] if the scene lacks the positions of its spots or the lengths of its
    /// beams; the store's errors.
    pub(super) fn read(
        stores: &Stores,
        (dataset, found, quantity): (&Dataset, &Manifest, Quantity),
        places: Places,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let missing = found.missing();
        let needed = ["transient", "spots.path"];
        if let Some(none) = missing.iter().find(|m| needed.contains(&m.as_str())) {
            return Err(TaskError::User(format!(
                "source: scene {} of {} was imported without {none:?}, which taking a flash apart needs; import it with it",
                found.scene,
                dataset.place()
            )));
        }
        let read = Self::of(dataset, found.scene, quantity, places);
        stores.wait(control, read)
    }

    /// Reads a scene whose quantities are known to be there. The histograms of single spots are not
    /// read.
    ///
    /// # Errors
    /// Those of [`Dataset::read_histogram`] and [`Dataset::read`].
    pub async fn of(
        dataset: &Dataset,
        scene: u64,
        quantity: Quantity,
        places: Places,
    ) -> Result<Self, StorageError> {
        let spec = dataset.spec();
        let histogram = async {
            match quantity {
                Quantity::TransientSpots => Ok(Vec::new()),
                _ => dataset.read_histogram(scene, quantity).await,
            }
        };
        let (histogram, all, i, pose, laser) = futures::try_join!(
            histogram,
            dataset.read_spots(scene),
            dataset.read_intrinsics(scene),
            dataset.read::<f32>(scene, Quantity::Camera),
            dataset.read::<f32>(scene, Quantity::Laser),
        )?;
        let frame = Frame(&pose);
        let camera = frame.camera(Intrinsics {
            fx: i.fx,
            fy: i.fy,
            cx: i.cx,
            cy: i.cy,
            width: spec.width,
            height: spec.height,
        });
        let laser = frame.point([laser[0], laser[1], laser[2]]);
        let (mut which, mut spots) = (Vec::new(), Vec::new());
        for (k, number) in numbers(dataset, quantity).into_iter().enumerate() {
            let Some(spot) = all.get(number as usize).copied().flatten() else {
                continue;
            };
            let point = frame.point(spot.position);
            let way = point - laser;
            let folded = spot.path_m - way.length() > FOLDED * spot.path_m;
            let known = places == Places::Given || folded;
            which.push(k);
            spots.push(Spot {
                direction: way,
                place: known.then_some(Place {
                    point,
                    path_m: spot.path_m,
                }),
            });
        }
        Ok(Self {
            histogram,
            gate: spec.gate,
            camera,
            laser,
            spots,
            which,
        })
    }

    /// Returns the input of the method.
    pub fn capture(&self) -> Capture<'_> {
        Capture {
            histogram: &self.histogram,
            gate: self.gate,
            camera: &self.camera,
            laser: self.laser,
            spots: &self.spots,
        }
    }

    /// Returns the index of each of the capture's spots among those of the histogram.
    pub fn beams(&self) -> &[usize] {
        &self.which
    }

    /// Returns the evidence of all `count` spots of the histogram. Beams that hit nothing have
    /// zeros.
    pub(super) fn evidence_of_all(&self, count: usize, evidence: &Evidence) -> Vec<u8> {
        let each = Evidence::PLANES * self.capture().pixels();
        let mut all = vec![0; count * each];
        for (k, part) in self.which.iter().zip(evidence.codes.chunks_exact(each)) {
            all[k * each..][..each].copy_from_slice(part);
        }
        all
    }

    /// Returns the probabilities of all `count` spots of the histogram, times 255 and rounded.
    /// Beams that hit nothing light nothing.
    pub(super) fn of_all(&self, count: usize, lit: &[f32]) -> Vec<u8> {
        let pixels = self.capture().pixels();
        let mut all = vec![0; count * pixels];
        for (k, part) in self.which.iter().zip(lit.chunks_exact(pixels)) {
            for (to, p) in all[k * pixels..][..pixels].iter_mut().zip(part) {
                *to = byte(*p);
            }
        }
        all
    }
}

/// Returns a share times 255, rounded.
pub(super) fn byte(share: f32) -> u8 {
    (share.clamp(0.0, 1.0) * 255.0).round() as u8
}
