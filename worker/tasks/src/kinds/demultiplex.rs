//! Demultiplexing: stores depth, and the pixels that each spot lights, of a scene, computed by
//! physics from the histogram of all spots. The task adopts predictions that exist, or computes and
//! publishes them in the form of an infer stage.

mod flash;

use picofarm_dataset::{Dataset, ENCODER_VERSION, Manifest};
use picofarm_demultiplex::{Settings, VERSION, demultiplex};
use picofarm_proto::{
    key::TaskKey,
    spec::{
        TaskSpec,
        kinds::{DemultiplexTask, demultiplex::DemultiplexSettings},
    },
};
use picofarm_results::{
    ModelUsed, Predicted, PredictionManifest, PredictionSpec, Predictions, SceneUsed,
};
use picofarm_store::sha256_hex;
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::{
    errors::dataset_error,
    input::source_manifest,
    making::predicted::{self, agreement},
    stores::manifest_sha256,
    task::{Context, Control, Output, RunTask, Task, TaskError, proceed},
};

pub use flash::Flash;
use flash::{byte, check_gate, numbers, quantity};

/// Name of the method in manifests, in place of a model's.
const METHOD: &str = "demultiplex";
/// Progress of the task after reading and after the method.
const READ: f32 = 0.1;
const APART: f32 = 0.95;

/// Returns the version of all code that determines the bytes of predictions and their manifests:
/// the method, encoder and agreement figures.
fn version() -> String {
    format!("{VERSION}/{ENCODER_VERSION}/{}", agreement::VERSION)
}

impl RunTask for DemultiplexTask {
    fn code_version() -> String {
        version()
    }

    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, place, index) = (&context.stores, &self.source, task.index);
        let dataset = stores.open_source(&place.store, &place.dataset, control)?;
        stores.fits(TaskSpec::Demultiplex(self.clone()), Some(dataset.spec()))?;
        let histogram = quantity(&dataset, self.demultiplex.histogram)?;
        check_gate(&dataset)?;
        let found = source_manifest(stores, &dataset, index, control)?;
        let mut manifest = manifest(self, index, &found);
        let (store, prefix) = stores.probed(&self.output.store, control)?;
        let prefix = prefix.join(&*self.output.dataset);
        let spec = spec(&dataset, numbers(&dataset, histogram));
        let opened = Predictions::create_or_open(store, prefix, &spec);
        let predictions = stores.wait(control, opened)?;
        if !task.spec.force
            && let Some(there) = predicted::adopted(stores, &predictions, &manifest, control)?
        {
            return Ok(there);
        }
        control.say("reads the histogram".into(), &[]);
        let flash = Flash::read(
            stores,
            (&dataset, &found, histogram),
            self.demultiplex.places,
            control,
        )?;
        proceed(control, READ)?;
        control.say("takes the flash apart".into(), &[]);
        let made = demultiplex(&flash.capture(), &Settings::default()).map_err(|e| {
            TaskError::User(format!(
                "source: scene {index} of {place}: {e}",
                place = dataset.place()
            ))
        })?;
        proceed(control, APART)?;
        let answers = Predicted {
            lit: flash.of_all(spec.spots.len(), &made.lit),
            depth_m: made.depth_m,
            specular: made.mirror_probability.iter().map(|m| byte(*m)).collect(),
            confidence: made.confidence.iter().map(|c| byte(*c)).collect(),
        };
        manifest.agreement =
            agreement::measure(stores, (&dataset, index), &answers, &spec.spots, control)?;
        let encoded = predictions
            .encode(manifest, &answers)
            .map_err(dataset_error)?;
        predicted::publish(stores, &predictions, &encoded, control)
    }
}

/// Returns the layout of the group of predictions.
fn spec(dataset: &Dataset, spots: Vec<u32>) -> PredictionSpec {
    let source = dataset.spec();
    PredictionSpec {
        scenes: source.scenes,
        height: source.height,
        width: source.width,
        depth: true,
        spots,
        specular: true,
        confidence: true,
    }
}

/// Returns the manifest of a scene's predictions, without the list of its objects.
fn manifest(task: &DemultiplexTask, scene: u64, found: &Manifest) -> PredictionManifest {
    let source = SceneUsed {
        dataset: task.source.dataset.clone(),
        task_key: found.provenance.task_key.clone(),
        manifest_sha256: manifest_sha256(found),
    };
    let input = DemultiplexSettings {
        version: String::new(),
        ..task.demultiplex.clone()
    };
    let method = json!([version(), input, Settings::default()]).to_string();
    let used = ModelUsed {
        name: METHOD.to_owned(),
        manifest_sha256: sha256_hex(method.as_bytes()),
        histogram: task.demultiplex.histogram.name().to_owned(),
        spots: Vec::new(),
    };
    let named = json!([source.manifest_sha256, method]);
    let key = TaskKey(Sha256::digest(named.to_string()).into());
    let kinds = ["tof", "shadow", "specular"].map(|kind| (kind.to_owned(), used.clone()));
    PredictionManifest {
        scene,
        task_key: key.to_string(),
        code: version(),
        source,
        models: kinds.into(),
        ..PredictionManifest::default()
    }
}
