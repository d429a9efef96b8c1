//! Applies a sensor to a scene of a data set and encodes the result for another data set.

use picofarm_dataset::{
    Dataset, DatasetSpec, ENCODER_VERSION, EncodedScene, Gate, Manifest, Profile, Provenance,
    Quantity, Subsets,
};
use picofarm_proto::{
    key::{TaskKey, derived_key},
    spec::{Histogram, ReprocessSettings, ReprocessTask, SourceSettings, TaskSpec},
    trace,
};
use picofarm_sensor::{
    Frame, Histograms, Multiplex, PS_PER_M, SENSOR_VERSION, Sensed, Sensor, SensorError, Values,
    sense_image,
};
use serde_json::json;
use tracing::debug_span;

use crate::{
    errors::dataset_error,
    input::{counts, quantity, source_manifest},
    stores::{Stores, manifest_sha256},
    task::{Control, TaskError, proceed},
};

/// Progress of the task after reading the histogram and after simulating the sensor.
const READ: f32 = 0.3;

const MEASURED: f32 = 0.8;

/// Returns the version of all code of this program that determines a reprocessed scene's bytes:
/// sensor model and encoder. Part of every key.
pub fn sensor_version() -> String {
    format!("{SENSOR_VERSION}/{ENCODER_VERSION}")
}

/// Inputs for making a scene.
pub(crate) struct Reprocessing {
    source: Dataset,
    /// The source's manifest of the scene.
    found: Manifest,
    sensor: Sensor,
    /// The data set that receives the scene.
    pub(crate) spec: DatasetSpec,
    /// Key of the task that makes the scene.
    pub(crate) key: TaskKey,
}

impl Reprocessing {
    /// Checks the source's scene `index` without accessing the target.
    pub(crate) fn open(
        stores: &Stores,
        task: &ReprocessTask,
        index: u64,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let (settings, profile) = (&task.reprocess, &task.output.profile);
        let ours = sensor_version();
        if settings.version != ours {
            return Err(TaskError::User(format!(
                "reprocess.version: the job asks for {:?}, this worker's sensor model is {ours:?}; submit the job again with \
                 this version, or run workers of the other one",
                settings.version
            )));
        }
        let source = open_source(stores, &task.source, control)?;
        stores.fits(TaskSpec::Reprocess(task.clone()), Some(source.spec()))?;
        let spec = target_spec(source.spec(), settings, profile)?;
        let found = source_manifest(stores, &source, index, control)?;
        let source_key = TaskKey::parse(&found.provenance.task_key).ok_or_else(|| {
            TaskError::User(format!(
                "source.dataset: the manifest of scene {index} names the task {:?}, which is no key of a task",
                found.provenance.task_key
            ))
        })?;
        let key = derived_key(&settings.stage_key(profile), &source_key);
        Ok(Self {
            source,
            found,
            sensor: settings.sensor.clone(),
            spec,
            key,
        })
    }

    /// Reads the scene, simulates the sensor, and encodes the result for `dataset`.
    pub(crate) fn encode(
        &self,
        stores: &Stores,
        dataset: &Dataset,
        settings: &ReprocessSettings,
        index: u64,
        control: &Control,
    ) -> Result<EncodedScene, TaskError> {
        let source = &self.source;
        let h = debug_span!(target: trace::TARGET, "read")
            .in_scope(|| read(stores, source, settings, index, control))?;
        proceed(control, READ)?;
        if let Some(field) = self.sensor.disturbs()
            && !settings.on_counts
            && counts::are_counts(&h, self.found.scale, &self.found.provenance.plan)
        {
            return Err(TaskError::User(format!(
                "reprocess.sensor: scene {index} of {}: {}; to sum bins or spots only, set pulse = {{ kind = \"none\" }}, \
                 jitter = {{ kind = \"gaussian\", fwhm_ps = 0.0 }}, scale = {{ kind = \"fixed\", photons_per_unit = 1.0 }} and \
                 poisson = false; to add the sensor's noise all the same, set reprocess.on_counts = true (--on-counts)",
                source.place(),
                counts::refusal(field)
            )));
        }
        let input = Histograms {
            transient: &h,
            two_bounce: None,
            bins: source.spec().gate.bins as usize,
            bin_width_ps: source.spec().gate.bin_width_m * PS_PER_M,
        };
        let frame = Frame {
            width: source.spec().width as usize,
            start_ps: source.spec().gate.start_m * PS_PER_M,
        };
        // The key determines every random number. It already covers the scene's number.
        let seed = u64::from_le_bytes(self.key.0[..8].try_into().expect("a key has 32 bytes"));
        let sensed = debug_span!(target: trace::TARGET, "measure")
            .in_scope(|| sense_image(&self.sensor, &input, &frame, seed, 0))
            .map_err(of_sensor)?;
        drop(h);
        proceed(control, MEASURED)?;
        let truth = stores.wait(control, source.read_truth(index))?;
        let truth = match chosen(settings) {
            None => truth,
            Some(spots) => truth.of_spots(&spots).map_err(dataset_error)?,
        };
        let provenance = Provenance {
            task_key: self.key.to_string(),
            renderer: settings.version.clone(),
            seed,
            plan: account(settings, &self.found, &sensed),
        };
        let (transient, scale) = as_radiance(&sensed);
        drop(sensed.values);
        debug_span!(target: trace::TARGET, "encode")
            .in_scope(|| dataset.encode_derived(index, &truth, &transient, scale, &provenance))
            .map_err(dataset_error)
    }
}

pub(crate) fn open_source(
    stores: &Stores,
    place: &SourceSettings,
    control: &Control,
) -> Result<Dataset, TaskError> {
    let opened = stores.open_source(&place.store, &place.dataset, control);
    opened.map_err(|error| match error {
        TaskError::User(text) => TaskError::User(format!("source: {text}")),
        other => other,
    })
}

/// Returns the properties of the data set that a source is reprocessed into.
///
/// # Errors
/// [`TaskError::User`] naming the setting that does not fit the source.
pub fn target_spec(
    source: &DatasetSpec,
    settings: &ReprocessSettings,
    profile: &str,
) -> Result<DatasetSpec, TaskError> {
    let user = |field: &str, what: String| TaskError::User(format!("reprocess.{field}: {what}"));
    let quantity = quantity(settings.histogram);
    if !source.quantities().contains(&quantity) {
        let there: Vec<&str> = source
            .quantities()
            .into_iter()
            .filter(|q| q.is_transient())
            .map(Quantity::name)
            .collect();
        let what = format!(
            "the source has no {}; it has {}",
            quantity.name(),
            there.join(", ")
        );
        return Err(user("histogram", what));
    }
    if let Some(spot) = settings.spots.iter().find(|s| **s >= source.spots) {
        let what = format!(
            "{spot}: the source has {} spots, counted from 0",
            source.spots
        );
        return Err(user("spots", what));
    }
    if let Some(zones) = settings.sensor.zones
        && (zones.rows, zones.columns) != (source.height, source.width)
    {
        let what = format!(
            "{}x{} zones of {}x{} pixels (rows x columns): depth, masks and labels have no mean over a zone; render \
             the data set with one pixel for each zone, whose histogram is the mean over its area, or leave zones out",
            zones.rows, zones.columns, source.height, source.width
        );
        return Err(user("sensor.zones", what));
    }
    let own = settings.sensor.gate;
    let gate = own.map_or(source.gate, |own| Gate {
        start_m: own.start_ps / PS_PER_M,
        bin_width_m: own.bin_width_ps / PS_PER_M,
        bins: own.bins,
    });
    let (bins, rebin) = (gate.bins, settings.sensor.rebin);
    let whose = if own.is_some() { "sensor" } else { "source" };
    if rebin > bins {
        let what = format!("{rebin} is more than the {whose}'s {bins} bins");
        return Err(user("sensor.rebin", what));
    }
    if bins % rebin != 0 && !settings.drop_left_over {
        let what = format!(
            "{rebin} does not divide the {whose}'s {bins} bins; set drop_left_over (--drop-left-over) to drop the last {}, \
             or choose a divisor",
            bins % rebin
        );
        return Err(user("sensor.rebin", what));
    }
    let profile =
        Profile::parse(profile).map_err(|e| TaskError::User(format!("output.profile: {e}")))?;
    Ok(DatasetSpec {
        spots: chosen(settings).map_or(source.spots, |spots| spots.len() as u32),
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: source.wavelengths_nm,
        gate: Gate {
            start_m: gate.start_m,
            bin_width_m: gate.bin_width_m * f64::from(rebin),
            bins: bins / rebin,
        },
        profile,
        ..*source
    })
}

/// Returns the source's spots that light the target; `None` = all.
fn chosen(settings: &ReprocessSettings) -> Option<Vec<u32>> {
    match settings.histogram {
        Histogram::Transient => None,
        Histogram::TransientSpots => Some(settings.spots.clone()),
        subset => Some(quantity(subset).spots_of_100().to_vec()),
    }
}

/// Reads the selected histogram h as `[row][column][bin]`.
fn read(
    stores: &Stores,
    source: &Dataset,
    settings: &ReprocessSettings,
    index: u64,
    control: &Control,
) -> Result<Vec<f32>, TaskError> {
    if settings.histogram != Histogram::TransientSpots {
        let read = source.read_histogram(index, quantity(settings.histogram));
        return stores.wait(control, read);
    }
    let mut sum = Multiplex::new(source.spec().transient_len());
    for (done, spot) in settings.spots.iter().enumerate() {
        proceed(control, READ * done as f32 / settings.spots.len() as f32)?;
        let h = stores.wait(control, source.read_spot(index, *spot))?;
        sum.add(&h).map_err(of_sensor)?;
    }
    Ok(sum.finish())
}

/// Returns the sensor's output in units of h, including dark counts, and the scale that converts it
/// to photons.
fn as_radiance(sensed: &Sensed) -> (Vec<f32>, f32) {
    use rayon::prelude::*;
    let scale = sensed.scale as f32;
    let h = match &sensed.values {
        Values::Counts(counts) => counts.par_iter().map(|n| *n as f32 / scale).collect(),
        Values::Rate(rate) => rate.par_iter().map(|r| r / scale).collect(),
    };
    (h, scale)
}

/// Describes the source and its processing for the manifest. The description depends on the task
/// only, with no location or time.
fn account(settings: &ReprocessSettings, source: &Manifest, sensed: &Sensed) -> serde_json::Value {
    let mut plan = json!({
        "kind": "reprocess",
        "source": {
            "task_key": source.provenance.task_key,
            "manifest_sha256": manifest_sha256(source),
            "renderer": source.provenance.renderer,
            "scale": source.scale,
        },
        "histogram": settings.histogram,
        "spots": chosen(settings),
        "sensor": settings.sensor,
        "drop_left_over": settings.drop_left_over,
        "seed": settings.seed,
        "value": match sensed.values {
            Values::Counts(_) => "counts: photons counted in the bin, dark counts included",
            Values::Rate(_) => "rate: photons expected in the bin, dark counts included",
        },
        "photons_per_unit": sensed.scale,
        "peak_photons": sensed.peak_photons,
        "shift_bins": sensed.shift_bins,
        "dropped": sensed.dropped,
        "labels": source.provenance.plan["labels"],
        "scene": source.provenance.plan["scene"],
    });
    // The ground truth is copied, so the list of its missing quantities is too.
    let missing = source.missing();
    if !missing.is_empty() {
        plan["missing"] = json!(missing);
    }
    let bounces = &source.provenance.plan["max_bounces"];
    if !bounces.is_null() {
        plan["max_bounces"] = bounces.clone();
    }
    plan
}

fn of_sensor(error: SensorError) -> TaskError {
    TaskError::User(format!("reprocess.{error}"))
}
