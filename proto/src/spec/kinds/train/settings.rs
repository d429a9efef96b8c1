//! Settings of trainings, and the resulting network.

use picofarm_settings::{
    Architecture, Precision, Schedule, Sensor, ShadowVariant, StemForm, Swin, Target,
    TimeProjection,
};
use serde::{Deserialize, Serialize};

use super::TIMES;
use crate::spec::{
    kinds::{
        io::{IoMut, ModelNames},
        reprocess::Histogram,
    },
    memory::{EVIDENCE_PLANES, Network, Shape},
    trial::Trial,
};

/// Settings of a training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainSettings {
    /// The prediction of the network.
    pub target: Target,
    /// The name under which the model is stored: letters, digits, `-`, `_` and `.`.
    pub model: String,
    /// The split of the data set. Its training scenes are learnt, and its validation scenes decide
    /// when to stop.
    #[serde(default = "default_split")]
    pub split: String,
    /// Number of training scenes, the first by the split's order, so that a smaller set is
    /// contained in a larger one. 0 means all.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub scenes: u64,
    /// Histogram of the data set.
    #[serde(default)]
    pub histogram: Histogram,
    /// Only these spots, summed. Requires `histogram = "transient_spots"`, which in turn requires
    /// it; ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// A sensor applied to histograms as they are read. Its noise is drawn again at each visit, and
    /// once for each scene in validation and evaluation. Without it, histograms are used as stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<Box<Sensor>>,
    /// The form of a histogram as network input.
    #[serde(default)]
    pub input: InputSettings,
    /// Divisor of depths, which a network predicts in 0 to 1, metres: about the greatest depth of
    /// the data set. Only for `target = "tof"`.
    #[serde(default = "of_rooms", skip_serializing_if = "is_of_rooms")]
    pub depth_scale_m: f64,
    /// The network.
    #[serde(default)]
    pub net: NetSettings,
    /// Settings of shadow prediction; only for `target = "shadow"`.
    #[serde(default, skip_serializing_if = "is_default")]
    pub shadow: ShadowSettings,
    /// Settings of mirror prediction; only for `target = "specular"`.
    #[serde(default, skip_serializing_if = "is_default")]
    pub specular: SpecularSettings,
    /// Steps, rates and precision.
    #[serde(default)]
    pub optimise: OptimiseSettings,
    /// Whether scenes are flipped at random, in both directions, together with their spots. Not
    /// allowed for shadow networks that know spots by their number (`index`, `all`), because a
    /// flipped spot is at another spot's place.
    #[serde(default = "yes")]
    pub augment: bool,
    /// Seed of weights, order of scenes, spots and flips.
    #[serde(default)]
    pub seed: u64,
    /// A trained model of the same network to start from, or the stage that trains it; empty means
    /// random weights.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub from: String,
    /// The program that computes the network.
    #[serde(default, skip_serializing_if = "is_default")]
    pub runtime: Runtime,
    /// Settings of PyTorch; only for `runtime = "torch"`.
    #[serde(default, skip_serializing_if = "is_default")]
    pub torch: TorchSettings,
    /// Processes that train the network together. They share the `accumulate` parts of each batch.
    /// With `runtime = "embedded"` each is a task for any worker: they come and go with their
    /// workers, and the result is bit-identical for any number of them. With `runtime = "torch"`
    /// all are on one worker, and their number must divide `accumulate`. Default 1.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub processes: u32,
    /// Minutes between checkpoints. A worker's death loses at most this much, plus the time to
    /// write one. 0 means after each step, and the next step waits for it, so that at most one step
    /// is lost. Does not affect the result.
    #[serde(default = "ten")]
    pub checkpoint_minutes: f64,
    /// Data that makes the training a trial of a sweep; written by `[stage.sweep]`, not by hand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trial: Option<Trial>,
    /// Version of networks and training, part of every task key; filled in at submission if
    /// omitted.
    #[serde(default)]
    pub version: String,
}

/// The program that computes a network in training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Runtime {
    /// The worker itself. The same settings give the same bits on every CPU.
    #[default]
    Embedded,
    /// PyTorch, in Python processes of workers that were started with `--python`. The same settings
    /// give similar weights, not the same bits.
    Torch,
}

/// Settings of PyTorch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TorchSettings {
    /// Whether `torch.compile` translates the network before it is trained. It needs a C++ compiler
    /// on the worker, and takes minutes at the start.
    pub compile: bool,
}

/// The form of a histogram as network input.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InputSettings {
    /// Normalisation of photons to numbers around 1.
    pub normalise: Normalise,
    /// For `normalise = "log"`: the largest bin of the data set, in its unit; 0 means that of the
    /// training scenes, which are read once to find it.
    #[serde(skip_serializing_if = "is_zero_f64")]
    pub max: f64,
    /// Bins of the input: adjacent bins are summed to this number, and bins left over at the end
    /// are dropped. 0 means all.
    pub bins: u32,
    /// Whether the input is the sum over bins, an image instead of a histogram.
    pub intensity_only: bool,
}

/// Normalisation of photons to numbers around 1 (appendix B of the paper).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Normalise {
    /// (h − min)/(max − min) of each pixel's histogram.
    #[default]
    Minmax,
    /// (log10(h + 1e-8) + 8)/(log10 max + 8), with the largest bin of the data set.
    Log,
}

/// The network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetSettings {
    /// Architecture.
    pub architecture: Architecture,
    /// Channels of the first level of a U-Net; each further level has twice as many. For `swinir`
    /// the channels of all features, for `embeddings` those of the volume's features, for `nlost`
    /// those of its attention.
    pub width: u32,
    /// Levels of a U-Net's encoder. The image is halved between two levels.
    pub levels: u32,
    /// Channels of a projection before the first level, as in the paper's appendix (128); 0 means
    /// none, as in the released code.
    pub stem: u32,
    /// The form of that projection.
    #[serde(skip_serializing_if = "is_default")]
    pub stem_form: StemForm,
    /// For `unet25d`: bins of time after the learnt projection of each stream; its levels halve
    /// them. Otherwise 0.
    #[serde(skip_serializing_if = "is_zero_u32")]
    pub time_features: u32,
    /// For `unet25d`: whether both streams share that projection, as in the released code.
    #[serde(skip_serializing_if = "is_default")]
    pub time_projection: TimeProjection,
    /// For `swinir`: its groups, blocks, heads and windows.
    #[serde(skip_serializing_if = "is_default")]
    pub swin: Swin,
}

/// Settings of shadow prediction (appendix A.1 of the paper).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ShadowSettings {
    /// The network's input for a spot.
    pub variant: ShadowVariant,
    /// Source of two-bounce times: the depths of the `truth`, an infer or demultiplex stage, or the
    /// folder in the source's store that one wrote. For `evidence`, a demultiplex stage with
    /// `evidence = true`, or its folder.
    pub times: String,
}

/// Settings of mirror prediction.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpecularSettings {
    /// A trained ToF model, or the stage that trains it, with frozen features from which a decoder
    /// learns; empty means a separate network, from scratch.
    pub on: String,
}

/// Steps, rates and precision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimiseSettings {
    /// Number of times that each training scene is seen.
    pub epochs: u32,
    /// Scenes a step.
    pub batch: u32,
    /// Parts in which a batch is computed to save memory. Their gradients are summed. Must divide
    /// the batch.
    pub accumulate: u32,
    /// Largest learning rate (AdamW).
    pub learning_rate: f64,
    /// Weight decay (AdamW).
    pub weight_decay: f64,
    /// Schedule of the learning rate.
    pub schedule: Schedule,
    /// Number format in which the network is computed.
    pub precision: Precision,
    /// For `schedule = "restarts"`: the cycles.
    #[serde(skip_serializing_if = "is_default")]
    pub restarts: RestartSettings,
    /// Largest norm of the gradients of all parameters together; longer gradients are shortened to
    /// it (PyTorch's `clip_grad_norm_`). 0 means no limit.
    #[serde(skip_serializing_if = "is_zero_f64")]
    pub clip_norm: f64,
    /// Decay of an exponential moving average of all weights and statistics, e.g. 0.999. The
    /// average is validated and stored instead of the weights. At step t the decay is at most (1 +
    /// t)/(10 + t). 0 means none.
    #[serde(skip_serializing_if = "is_zero_f64")]
    pub ema: f64,
    /// Stops after this many validations without improvement; 0 means never.
    pub early_stop: u32,
    /// Steps between additional validations within an epoch, counted from the beginning; 0 means
    /// only at the end of each epoch.
    #[serde(skip_serializing_if = "is_zero_u32")]
    pub validate_every: u32,
}

/// The cycles of `schedule = "restarts"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RestartSettings {
    /// Epochs of the first cycle.
    pub first: u32,
    /// Ratio of the lengths of consecutive cycles.
    pub factor: u32,
}

impl Default for RestartSettings {
    fn default() -> Self {
        Self {
            first: 10,
            factor: 2,
        }
    }
}

impl Default for NetSettings {
    fn default() -> Self {
        Self {
            architecture: Architecture::Unet2d,
            width: 128,
            levels: 6,
            stem: 0,
            stem_form: StemForm::Block,
            time_features: 0,
            time_projection: TimeProjection::Shared,
            swin: Swin::default(),
        }
    }
}

impl Default for ShadowSettings {
    fn default() -> Self {
        Self {
            variant: ShadowVariant::Concat,
            times: TRUTH.into(),
        }
    }
}

impl Default for OptimiseSettings {
    fn default() -> Self {
        Self {
            epochs: 200,
            batch: 32,
            accumulate: 1,
            learning_rate: 1e-2,
            weight_decay: 1e-3,
            schedule: Schedule::Onecycle,
            precision: Precision::F32,
            restarts: RestartSettings::default(),
            clip_norm: 0.0,
            ema: 0.0,
            early_stop: 0,
            validate_every: 0,
        }
    }
}

/// [`ShadowSettings::times`] for two-bounce times from the ground truth.
pub const TRUTH: &str = "truth";

/// [`TrainSettings::depth_scale_m`] for furnished rooms.
const OF_ROOMS_M: f64 = 4.5;

fn of_rooms() -> f64 {
    OF_ROOMS_M
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
pub(super) fn is_of_rooms(scale: &f64) -> bool {
    *scale == OF_ROOMS_M
}

fn default_split() -> String {
    "default".into()
}

fn yes() -> bool {
    true
}

fn one() -> u32 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_one(n: &u32) -> bool {
    *n == 1
}

fn ten() -> f64 {
    10.0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
pub(in crate::spec::kinds) fn is_zero(n: &u64) -> bool {
    *n == 0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero_u32(n: &u32) -> bool {
    *n == 0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero_f64(n: &f64) -> bool {
    *n == 0.0
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl TrainSettings {
    /// Returns the shape of the network for such scenes.
    pub(in crate::spec) fn network(&self, source: &Shape) -> Network {
        let bins = match self.input.bins {
            0 => source.bins,
            bins => bins,
        };
        let seen = match self.input.intensity_only {
            true => 1.0,
            false => f64::from(bins),
        };
        let (dense, one_hot) = match (self.target, self.shadow.variant) {
            (Target::Shadow, ShadowVariant::Concat) => (seen, f64::from(bins)),
            (Target::Shadow, ShadowVariant::Index) => (seen + f64::from(source.spots), 0.0),
            (Target::Shadow, ShadowVariant::Evidence) => (f64::from(EVIDENCE_PLANES), 0.0),
            _ => (seen, 0.0),
        };
        let net = &self.net;
        let linear = net.stem > 0 && net.stem_form == StemForm::Linear;
        Network {
            scene: *source,
            inputs: dense + one_hot,
            // A linear stem receives one-hot channels as dense ones.
            dense: if linear { dense + one_hot } else { dense },
            width: f64::from(net.width),
            levels: net.levels,
            time: match net.architecture {
                Architecture::Unet25d => f64::from(net.time_features.max(1)),
                Architecture::Unet2d
                | Architecture::Swinir
                | Architecture::Embeddings
                | Architecture::Nlost => 1.0,
            },
            architecture: net.architecture,
            swin: net.swin,
            stem: f64::from(net.stem),
            stem_taps: if linear { 1.0 } else { 9.0 },
        }
    }

    /// Returns the settings that affect the bytes of the model: all except its name, the number of
    /// processes, the interval of checkpoints, and its sweep.
    pub fn shaping(&self) -> serde_json::Value {
        let mut settings = serde_json::to_value(self).expect("settings are plain data");
        let table = settings.as_object_mut().expect("settings are a table");
        table.remove("model");
        table.remove("checkpoint_minutes");
        table.remove("processes");
        table.remove("trial");
        settings
    }

    /// Returns whether the network takes the evidence of a demultiplex stage.
    pub fn takes_evidence(&self) -> bool {
        self.target == Target::Shadow && self.shadow.variant == ShadowVariant::Evidence
    }

    /// Returns the folder of predictions that two-bounce times come from, if any.
    pub fn times(&self) -> Option<&String> {
        Some(&self.shadow.times).filter(|times| *times != TRUTH)
    }

    /// Returns the models on which this training builds: field and name.
    pub fn models(&self) -> Vec<(&'static str, &String)> {
        let mut models = Vec::new();
        if !self.specular.on.is_empty() {
            models.push(("train.specular.on", &self.specular.on));
        }
        if !self.from.is_empty() {
            models.push(("train.from", &self.from));
        }
        models
    }

    /// Returns the fields that a submission fills in.
    pub(crate) fn io_mut(&mut self) -> IoMut<'_> {
        let from_folder = self.times().is_some();
        let models = [
            ("train.specular.on", &mut self.specular.on),
            ("train.from", &mut self.from),
        ];
        let named = models.into_iter().filter(|(_, name)| !name.is_empty());
        IoMut {
            version: Some(&mut self.version),
            folder: from_folder.then_some((TIMES, &mut self.shadow.times)),
            models: ModelNames::Single(named.collect()),
            ..IoMut::default()
        }
    }
}
