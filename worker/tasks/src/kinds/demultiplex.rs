//! Demultiplexing: stores depth, and the pixels that each spot lights, of a scene, computed by
//! physics from the histogram of all spots, or by another method from that of each spot. The task
//! adopts predictions that exist, or computes and publishes them in the form of an infer stage.

mod flash;

use picofarm_dataset::{Dataset, ENCODER_VERSION, Manifest, Quantity};
use picofarm_demultiplex::{
    DemultiplexError, Demultiplexed, Evidence, SEPARATE_VERSION, Separate, Settings, VERSION,
    demultiplex, residual, separate, shadows_at, with_evidence,
};
use picofarm_proto::{
    key::TaskKey,
    spec::{
        Histogram, TaskSpec,
        kinds::{
            DemultiplexTask,
            demultiplex::{DemultiplexSettings, DepthSource, Method},
        },
        memory::EVIDENCE_PLANES,
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
    input::{
        source_manifest,
        truth::{self, Need},
    },
    making::predicted::{self, agreement},
    stores::manifest_sha256,
    task::{Context, Control, Output, RunTask, Task, TaskError, proceed},
};

pub use flash::Flash;
use flash::{byte, check_gate, numbers, quantity, separate_quantity};

/// Name of the physical method in manifests, in place of a model's.
const METHOD: &str = "demultiplex";
/// The memory of tasks is estimated from this number.
const _: () = assert!(Evidence::PLANES == EVIDENCE_PLANES as usize);
/// Progress of the task after reading and after the method.
const READ: f32 = 0.1;
const APART: f32 = 0.95;

/// Returns the version of all code that determines the bytes of predictions and their manifests:
/// the methods, encoder and agreement figures.
fn version() -> String {
    format!(
        "{VERSION}/{SEPARATE_VERSION}/{ENCODER_VERSION}/{}",
        agreement::VERSION
    )
}

impl RunTask for DemultiplexTask {
    fn code_version() -> String {
        version()
    }

    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, place, index) = (&context.stores, &self.source, task.index);
        let dataset = stores.open_source(&place.store, &place.dataset, control)?;
        stores.fits(TaskSpec::Demultiplex(self.clone()), Some(dataset.spec()))?;
        let histogram = match self.demultiplex.method {
            Method::Physics => quantity(&dataset, self.demultiplex.histogram)?,
            other => separate_quantity(&dataset, other)?,
        };
        check_gate(&dataset)?;
        let found = source_manifest(stores, &dataset, index, control)?;
        if self.demultiplex.depth == DepthSource::Truth {
            let place = dataset.place();
            truth::check(&place, &[Need::DepthOfShadows], &[(index, found.missing())])?;
        }
        let mut manifest = manifest(self, index, &found);
        let (store, prefix) = stores.probed(&self.output.store, control)?;
        let prefix = prefix.join(&*self.output.dataset);
        let spec = self.spec(&dataset, numbers(&dataset, histogram));
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
        let depth = match self.demultiplex.depth {
            DepthSource::Own => None,
            DepthSource::Truth => {
                let read = dataset.read::<f32>(index, Quantity::Depth);
                Some(stores.wait(control, read)?)
            }
        };
        let user = |e: DemultiplexError| {
            let place = dataset.place();
            TaskError::User(format!("source: scene {index} of {place}: {e}"))
        };
        let (made, evidence) = match self.separate() {
            None => {
                control.say("takes the flash apart".into(), &[]);
                self.apart(&flash, depth.as_deref()).map_err(user)?
            }
            Some(method) => {
                let mut read = |spot: usize| {
                    let beam = flash.beams()[spot];
                    control.say(format!("capture of spot {beam}"), &[]);
                    proceed(control, READ)?;
                    Ok(stores.wait(control, dataset.read_spot(index, beam as u32))?)
                };
                let made = separate(&flash.capture(), method, found.scale, &mut read);
                let made = made.map_err(|e| match e {
                    Failed::Method(e) => user(e),
                    Failed::Task(e) => e,
                })?;
                (made, None)
            }
        };
        proceed(control, APART)?;
        // Other methods' masks lack spots, whose peaks would be taken for others.
        let physics = depth.is_none() && self.separate().is_none();
        let peaks = physics.then(|| residual(&flash.capture(), &made));
        let spots = spec.spots.len();
        let mut answers = Predicted {
            lit: flash.of_all(spots, &made.lit),
            evidence: evidence.map_or_else(Vec::new, |e| flash.evidence_of_all(spots, &e)),
            ..Predicted::default()
        };
        if depth.is_none() {
            answers.depth_m = made.depth_m;
            // Methods for separate captures find no mirrors.
            if spec.specular {
                answers.specular = made.mirror_probability.iter().map(|m| byte(*m)).collect();
            }
            answers.confidence = made.confidence.iter().map(|c| byte(*c)).collect();
        }
        manifest.agreement =
            agreement::measure(stores, (&dataset, index), &answers, &spec.spots, control)?;
        // Depth that follows from spots agrees with them by construction, also in noise.
        if let Some(peaks) = peaks.filter(|_| manifest.agreement.is_object()) {
            manifest.agreement["peaks"] = json!(peaks);
            manifest.agreement["spots"] = json!(flash.beams().len());
        }
        let encoded = predictions
            .encode(manifest, &answers)
            .map_err(dataset_error)?;
        predicted::publish(stores, &predictions, &encoded, control)
    }
}

/// The failure of a method that reads captures itself.
enum Failed {
    Method(DemultiplexError),
    Task(TaskError),
}

impl From<DemultiplexError> for Failed {
    fn from(e: DemultiplexError) -> Self {
        Self::Method(e)
    }
}

impl From<TaskError> for Failed {
    fn from(e: TaskError) -> Self {
        Self::Task(e)
    }
}

/// How one task takes a flash apart.
trait Work {
    /// Returns the method, if it is one for separate captures.
    fn separate(&self) -> Option<Separate>;

    /// Returns the layout of the group of predictions.
    fn spec(&self, dataset: &Dataset, spots: Vec<u32>) -> PredictionSpec;

    /// Takes a flash apart, at known depths if there are any, and returns the evidence if it is to
    /// be stored.
    fn apart(
        &self,
        flash: &Flash,
        depth_m: Option<&[f32]>,
    ) -> Result<(Demultiplexed, Option<Evidence>), DemultiplexError>;
}

impl Work for DemultiplexTask {
    fn separate(&self) -> Option<Separate> {
        match self.demultiplex.method {
            Method::Physics => None,
            Method::MatchedFilter => Some(Separate::MatchedFilter),
            Method::Likelihood => Some(Separate::Likelihood),
        }
    }

    fn spec(&self, dataset: &Dataset, spots: Vec<u32>) -> PredictionSpec {
        let source = dataset.spec();
        let own = self.demultiplex.depth == DepthSource::Own;
        PredictionSpec {
            scenes: source.scenes,
            height: source.height,
            width: source.width,
            depth: own,
            spots,
            specular: own && self.separate().is_none(),
            confidence: own,
            evidence: self.demultiplex.evidence.then(Evidence::form),
        }
    }

    fn apart(
        &self,
        flash: &Flash,
        depth_m: Option<&[f32]>,
    ) -> Result<(Demultiplexed, Option<Evidence>), DemultiplexError> {
        let (capture, settings) = (flash.capture(), Settings::default());
        if self.demultiplex.evidence {
            let (made, evidence) = with_evidence(&capture, depth_m, &settings)?;
            return Ok((made, Some(evidence)));
        }
        let made = match depth_m {
            Some(depth_m) => shadows_at(&capture, depth_m, &settings)?,
            None => demultiplex(&capture, &settings)?,
        };
        Ok((made, None))
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
        name: match task.demultiplex.method {
            Method::Physics => METHOD,
            other => other.name(),
        }
        .to_owned(),
        manifest_sha256: sha256_hex(method.as_bytes()),
        histogram: match task.demultiplex.method {
            Method::Physics => task.demultiplex.histogram,
            _ => Histogram::TransientSpots,
        }
        .name()
        .to_owned(),
        spots: Vec::new(),
    };
    let named = json!([source.manifest_sha256, method]);
    let key = TaskKey(Sha256::digest(named.to_string()).into());
    let kinds: &[&str] = match task.demultiplex.depth {
        DepthSource::Own if task.separate().is_some() => &["tof", "shadow"],
        DepthSource::Own => &["tof", "shadow", "specular"],
        DepthSource::Truth => &["shadow"],
    };
    let kinds = kinds.iter().map(|kind| ((*kind).to_owned(), used.clone()));
    PredictionManifest {
        scene,
        task_key: key.to_string(),
        code: version(),
        source,
        models: kinds.collect(),
        ..PredictionManifest::default()
    }
}
