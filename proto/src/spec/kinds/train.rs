//! Training: trains a network on the scenes of a data set and stores it under a name. One task.
//! Defaults come from the published experiments (Shoot-Bounce-3D: the paper, its appendix and its
//! released code).

use picofarm_settings::Spots;
pub use picofarm_settings::{
    Architecture, Precision, Schedule, ShadowVariant, StemForm, Target, TimeProjection,
};
use serde::Serialize;
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Manifest, Results, Taken, TaskKind, holds},
    scenes::SceneSource,
};
use crate::spec::{
    destination::Destination,
    limits::check_count,
    memory::{BASE, Known},
    places::{MODELS, SourceSettings, check_source},
    spec_error::SpecError,
};

mod check;
mod settings;

pub use super::names::check_model;
pub(super) use check::check_spots;
pub(super) use settings::is_zero;
pub use settings::{
    InputSettings, NetSettings, Normalise, OptimiseSettings, RestartSettings, Runtime,
    ShadowSettings, SpecularSettings, TRUTH, TorchSettings, TrainSettings,
};

/// The field of [`ShadowSettings::times`].
const TIMES: &str = "train.shadow.times";

/// The ability to train by PyTorch.
pub const TORCH: &str = "torch";
/// Memory of a process with PyTorch and nothing else, in bytes.
const TORCH_BYTES: f64 = 600e6;

/// Trains a network: one task for each process, or one for all processes of PyTorch.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrainTask {
    /// The training data set. The model is stored in the same store.
    pub source: SourceSettings,
    /// Number of scenes of the data set.
    pub count: u64,
    /// Settings of the training.
    pub train: TrainSettings,
}

impl Declared for TrainTask {
    const NAME: &'static str = "train";
    const FIELDS: &'static [&'static str] = &["source", "count", "train"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            train: fields.required("train")?,
        })
    }
}

impl TaskKind for TrainTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("train.version", &self.train.version),
            source: Some(&self.source),
            folder: self.train.times().map(|times| (TIMES, times)),
            split: Some(&self.train.split),
            models: self.train.models(),
            makes: Makes::Model {
                store: &self.source.store,
                name: &self.train.model,
                training: Some(&self.train),
            },
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            source: Some((&mut self.source, &mut self.count)),
            ..self.train.io_mut()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.train.check()
    }

    fn shaping(&self) -> Value {
        let mut description = json!({
            "stage": "train",
            "source": self.source.shaping(),
            "count": self.count,
            "model": self.train.model,
            "settings": self.train.shaping(),
        });
        if let Some(trial) = &self.train.trial {
            description["trial"] = json!(trial);
        }
        description
    }

    fn results(&self) -> Results<'_> {
        let name = &*self.train.model;
        Results {
            field: "source.store",
            store: &self.source.store,
            folder: format!("{MODELS}/{name}"),
            destination: Destination::folder(
                "train.model",
                &self.source.store,
                format!("{MODELS}/{name}"),
            ),
            manifest: match &self.train.trial {
                Some(trial) => Manifest::Trial(trial),
                None => Manifest::Model { name },
            },
        }
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        let ours = self.train.network(source);
        let others = known.networks.iter().map(|n| n.ask(source));
        let images = self.train.optimise.batch / self.train.optimise.accumulate.max(1);
        let learns = ours.learn(source, images.max(1));
        // Sums of blocks of 2, 4, … parts of a batch wait for one another, plus the sums of other
        // processes.
        let waiting = self.train.optimise.accumulate.max(2).ilog2() - 1;
        let exchanged = if self.train.processes > 1 { 3 } else { 0 };
        let average = if self.train.optimise.ema > 0.0 { 1 } else { 0 };
        let sums = f64::from(waiting + exchanged + average) * ours.weights();
        // The output of a sensor takes the same memory as the scene.
        let sensed = self.train.sensor.as_ref().map_or(0.0, |_| source.two());
        let evidence = match self.train.takes_evidence() {
            true => source.evidence(),
            false => 0.0,
        };
        let by = match self.train.runtime {
            Runtime::Embedded => learns + sums,
            // This worker has the weights too.
            Runtime::Torch => {
                let each = learns + (2.0 + f64::from(average)) * ours.weights() + TORCH_BYTES;
                4.0 * ours.weights() + each * f64::from(self.train.processes)
            }
        };
        Some(BASE + source.two() + sensed + 2.0 * evidence + by + others.fold(0.0, f64::max))
    }

    /// The folder of two-bounce times must have depths or evidence. Spots that are known by their
    /// number must be at the same places in all scenes.
    fn check_among(&self, before: &[&dyn TaskKind]) -> Result<(), SpecError> {
        holds(self, Taken::of(&self.train), before)?;
        let numbered =
            self.train.target == Target::Shadow && self.train.shadow.variant.is_numbered();
        let spots = scenes_of(&self.source, before).map(|scenes| &scenes.spots);
        match spots {
            Some(Spots::Random(_)) if numbered => {
                let what = format!(
                    "{:?} knows spots by their number, but scenes.spots of the scenes are at other places in each; take \"concat\" \
                     or \"difference\", or a grid",
                    self.train.shadow.variant.name()
                );
                Err(SpecError::new("train.shadow.variant", what))
            }
            _ => Ok(()),
        }
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: match self.train.runtime {
                Runtime::Embedded => u64::from(self.train.processes),
                Runtime::Torch => 1,
            },
            resumes: true,
            variant: (self.train.runtime == Runtime::Torch).then_some(TORCH),
        }
    }
}

/// Returns the scenes of a data set, as far as earlier stages render or reprocess them.
fn scenes_of<'a>(
    source: &'a SourceSettings,
    before: &'a [&dyn TaskKind],
) -> Option<&'a SceneSource> {
    let mut source = source;
    for task in before.iter().rev() {
        if task.writes() != Some((&source.store, &source.dataset)) {
            continue;
        }
        if let Some(scenes) = task.scenes() {
            return Some(scenes);
        }
        source = task.reads()?;
    }
    None
}
