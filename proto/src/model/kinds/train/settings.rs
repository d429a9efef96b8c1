//! What is learnt, and how: the settings of trainings, and the network that follows from them.

use picofarm_settings::{
    Architecture, Precision, Schedule, Sensor, ShadowVariant, StemForm, Swin, Target,
    TimeProjection,
};
use serde::{Deserialize, Serialize};

use crate::model::{
    kinds::reprocess::Histogram,
    memory::{Network, Shape},
    trial::Trial,
};

/// What is learnt, and how.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainSettings {
    /// What the network predicts.
    pub target: Target,
    /// The name under which the model is kept in the store: letters, digits, `-`, `_` and `.`.
    pub model: String,
    /// The split of the data set whose training scenes are learnt from, and whose validation scenes tell when to stop.
    #[serde(default = "default_split")]
    pub split: String,
    /// Only so many training scenes, the first by the split's order: the fewer are always among the more. 0 = all.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub scenes: u64,
    /// Which of the data set's histograms.
    #[serde(default)]
    pub histogram: Histogram,
    /// Only these spots, summed: with `histogram = "transient_spots"`, which needs it; ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// A sensor through which histograms go when they are read, with noise that is drawn anew at each visit; for validation and
    /// evaluation once for each scene. Without it they are seen as stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<Box<Sensor>>,
    /// What the network sees of a histogram.
    #[serde(default)]
    pub input: InputSettings,
    /// By how many metres depths are divided, which a network predicts within 0 to 1: about the greatest of the data set; for
    /// `target = "tof"` only.
    #[serde(default = "of_rooms", skip_serializing_if = "is_of_rooms")]
    pub depth_scale_m: f64,
    /// The network.
    #[serde(default)]
    pub net: NetSettings,
    /// How shadows are predicted; for `target = "shadow"` only.
    #[serde(default, skip_serializing_if = "is_default")]
    pub shadow: ShadowSettings,
    /// What mirrors are predicted from; for `target = "specular"` only.
    #[serde(default, skip_serializing_if = "is_default")]
    pub specular: SpecularSettings,
    /// Steps, rates and precision.
    #[serde(default)]
    pub optimise: OptimiseSettings,
    /// Scenes are flipped at random, in both directions, together with their spots; not where a shadow network knows spots by
    /// their number (`index`, `all`), since a flipped spot is at another one's place.
    #[serde(default = "yes")]
    pub augment: bool,
    /// Seed of weights, order of scenes, spots and flips.
    #[serde(default)]
    pub seed: u64,
    /// A trained model of the same network, or the stage that trains it, to start from; empty = random weights.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub from: String,
    /// Processes that train it together, each a task of the stage that any worker takes; they share the `accumulate` parts of each
    /// batch. They come and go as workers do, and the result is the same to the bit however many there are. Default 1.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub processes: u32,
    /// Minutes between checkpoints: as much is lost at most when a worker dies, and what one takes to be written. 0 = after each
    /// step, and the next waits for it: no more than one step is lost. Changes no result.
    #[serde(default = "ten")]
    pub checkpoint_minutes: f64,
    /// What makes it a trial of a sweep; written by `[stage.sweep]`, not by hand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trial: Option<Trial>,
    /// Version of networks and training, part of every task key; filled in at submission where left out.
    #[serde(default)]
    pub version: String,
}

/// What a network sees of a histogram.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InputSettings {
    /// How photons become numbers around 1.
    pub normalise: Normalise,
    /// For `normalise = "log"`: the largest bin of the data set, in its unit; 0 = that of the training scenes, which are
    /// read once for it.
    #[serde(skip_serializing_if = "is_zero_f64")]
    pub max: f64,
    /// Bins of the input: adjacent bins are summed to so many, those left over at the end dropped. 0 = all.
    pub bins: u32,
    /// The sum over bins alone: a picture instead of a histogram.
    pub intensity_only: bool,
}

/// How photons become numbers around 1 (appendix B of the paper).
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
    /// Its kind.
    pub architecture: Architecture,
    /// Channels of the first level of a U-Net; each further one has twice as many. Of `swinir` the channels of all its
    /// features, of `embeddings` those of the volume's, of `nlost` those of its attention.
    pub width: u32,
    /// Levels of a U-Net's encoder; between two of them the image is halved.
    pub levels: u32,
    /// Channels of a projection before the first level, as in the paper's appendix (128); 0 = none, as in the released code.
    pub stem: u32,
    /// What that projection is.
    #[serde(skip_serializing_if = "is_default")]
    pub stem_form: StemForm,
    /// For `unet25d`: bins of time after the learnt projection of each stream; its levels halve them. 0 otherwise.
    #[serde(skip_serializing_if = "is_zero_u32")]
    pub time_features: u32,
    /// For `unet25d`: whether both streams share that projection, as in the released code.
    #[serde(skip_serializing_if = "is_default")]
    pub time_projection: TimeProjection,
    /// For `swinir`: its groups, blocks, heads and windows.
    #[serde(skip_serializing_if = "is_default")]
    pub swin: Swin,
}

/// How shadows are predicted (appendix A.1 of the paper).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ShadowSettings {
    /// What the network is given of a spot.
    pub variant: ShadowVariant,
    /// What two-bounce times follow from: the depths of the `truth`, or those of an infer stage, or of the folder in the source's
    /// store that one wrote.
    pub times: String,
}

/// What mirrors are predicted from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpecularSettings {
    /// A trained ToF model, or the stage that trains it, whose frozen features a decoder learns from; empty = a network
    /// of its own, from scratch.
    pub on: String,
}

/// Steps, rates and precision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimiseSettings {
    /// Times that each training scene is seen.
    pub epochs: u32,
    /// Scenes a step.
    pub batch: u32,
    /// Parts in which a batch is computed, to save memory; their gradients are added up. Must divide the batch.
    pub accumulate: u32,
    /// Largest learning rate (AdamW).
    pub learning_rate: f64,
    /// Weight decay (AdamW).
    pub weight_decay: f64,
    /// How the rate changes with the steps.
    pub schedule: Schedule,
    /// Numbers in which the network is computed.
    pub precision: Precision,
    /// For `schedule = "restarts"`: the cycles.
    #[serde(skip_serializing_if = "is_default")]
    pub restarts: RestartSettings,
    /// Gradients whose norm, of all parameters together, is greater are shortened to it (PyTorch's `clip_grad_norm_`); 0 = never.
    #[serde(skip_serializing_if = "is_zero_f64")]
    pub clip_norm: f64,
    /// Decay of an exponential moving average of all weights and statistics, e.g. 0.999, which is validated and kept in their place;
    /// at step t no more than (1 + t)/(10 + t). 0 = none.
    #[serde(skip_serializing_if = "is_zero_f64")]
    pub ema: f64,
    /// Stop after so many validations without improvement; 0 = never.
    pub early_stop: u32,
    /// Steps after which it is validated within an epoch too, counted from the beginning; 0 = at the end of each epoch only.
    #[serde(skip_serializing_if = "is_zero_u32")]
    pub validate_every: u32,
}

/// The cycles of `schedule = "restarts"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RestartSettings {
    /// Epochs of the first cycle.
    pub first: u32,
    /// Each further cycle is so many times as long.
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

/// [`ShadowSettings::times`] where two-bounce times are the ground truth's.
pub const TRUTH: &str = "truth";

/// [`TrainSettings::depth_scale_m`] of furnished rooms.
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
pub(in crate::model::kinds) fn is_zero(n: &u64) -> bool {
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
    /// The shape of the network that learns from such scenes.
    pub(in crate::model) fn network(&self, source: &Shape) -> Network {
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
            _ => (seen, 0.0),
        };
        let net = &self.net;
        let linear = net.stem > 0 && net.stem_form == StemForm::Linear;
        Network {
            scene: *source,
            inputs: dense + one_hot,
            // A linear stem is given one-hot channels as dense ones.
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

    /// What of them decides the bytes of the model: all but its name, by how many processes it is trained, how often it is
    /// saved on the way, and whether it is one of a sweep.
    pub fn shaping(&self) -> serde_json::Value {
        let mut settings = serde_json::to_value(self).expect("settings are plain data");
        let table = settings.as_object_mut().expect("settings are a table");
        table.remove("model");
        table.remove("checkpoint_minutes");
        table.remove("processes");
        table.remove("trial");
        settings
    }

    /// The folder of predictions that two-bounce times follow from, if any.
    pub fn times(&self) -> Option<&String> {
        Some(&self.shadow.times).filter(|times| *times != TRUTH)
    }

    /// The models that it builds on: field and name.
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

    /// The same, to be filled in.
    pub(crate) fn models_mut(&mut self) -> Vec<(&'static str, &mut String)> {
        let mut models = Vec::new();
        if !self.specular.on.is_empty() {
            models.push(("train.specular.on", &mut self.specular.on));
        }
        if !self.from.is_empty() {
            models.push(("train.from", &mut self.from));
        }
        models
    }
}
