//! Checks of a training's settings.

use picofarm_settings::{
    Architecture, Schedule, SensorError, ShadowVariant, StemForm, Swin, Target, TimeProjection,
};

use super::settings::{
    InputSettings, NetSettings, Normalise, OptimiseSettings, RestartSettings, Runtime,
    ShadowSettings, TorchSettings, TrainSettings, is_of_rooms,
};
use crate::spec::{
    kinds::{
        names::{check_model, check_split, check_times},
        reprocess::Histogram,
    },
    spec_error::{SpecError, within},
};

/// Most processes that train a network together.
const MOST_PROCESSES: u32 = 1_000;

impl TrainSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("train.{field}"), what));
        check_model("train.model", &self.model)?;
        for (field, model) in self.models() {
            check_model(field, model)?;
            if *model == self.model {
                let what = format!("{model:?} is the model itself; name another one");
                return Err(SpecError::new(field, what));
            }
        }
        check_split("train.split", &self.split)?;
        check_spots("train.spots", self.histogram, &self.spots)?;
        if self.target != Target::Shadow && self.shadow != ShadowSettings::default() {
            return fail(
                "shadow",
                format!("is not for target = {:?}; remove it", self.target.name()),
            );
        }
        if self.target != Target::Specular && !self.specular.on.is_empty() {
            return fail(
                "specular",
                format!("is not for target = {:?}; remove it", self.target.name()),
            );
        }
        let metres = "metres; 4.5 for furnished rooms";
        within(
            "train.depth_scale_m",
            self.depth_scale_m,
            (0.01, 1000.0),
            metres,
        )?;
        if self.target != Target::Tof && !is_of_rooms(&self.depth_scale_m) {
            return fail(
                "depth_scale_m",
                format!("is not for target = {:?}; remove it", self.target.name()),
            );
        }
        let unet = matches!(
            self.net.architecture,
            Architecture::Unet2d | Architecture::Unet25d
        );
        if !self.specular.on.is_empty() && !unet {
            let what = format!(
                "is for U-Nets, whose decoder learns on the features of a frozen encoder; architecture = {:?} has no such parts: \
                 remove it to learn mirrors from scratch",
                self.net.architecture.name()
            );
            return fail("specular.on", what);
        }
        let volume = matches!(
            self.net.architecture,
            Architecture::Embeddings | Architecture::Nlost
        );
        if volume && self.shadow.variant == ShadowVariant::Index {
            let what = format!(
                "\"index\" adds planes that are no moments of time, which architecture = {:?} cannot see; \
                 take variant = \"concat\", or another architecture",
                self.net.architecture.name()
            );
            return fail("shadow.variant", what);
        }
        if !self.specular.on.is_empty() && !self.from.is_empty() {
            let what = "is not for a network on the features of another (train.specular.on); remove one of them";
            return fail("from", what.into());
        }
        check_times("train.shadow.times", &self.shadow.times)?;
        if self.takes_evidence() {
            self.check_evidence()?;
        } else if self.times().is_some() && !self.shadow.variant.is_timed() {
            let what = format!(
                "is {:?}, but a network of variant {:?} is given no times; leave it out",
                self.shadow.times,
                self.shadow.variant.name()
            );
            return fail("shadow.times", what);
        }
        if let Some(trial) = &self.trial {
            trial.check("train.trial")?;
            if self.processes != 1 && self.runtime == Runtime::Embedded {
                let what = format!(
                    "is {}, but a trial of a sweep is one task; leave it out, and let workers take trials side by side",
                    self.processes
                );
                return fail("processes", what);
            }
        }
        let most = self.optimise.accumulate.clamp(1, MOST_PROCESSES);
        if !(1..=most).contains(&self.processes) {
            let what = format!(
                "is {}, expected 1 to {most}: processes share the optimise.accumulate = {} parts of each batch",
                self.processes, self.optimise.accumulate
            );
            return fail("processes", what);
        }
        self.check_torch()?;
        self.input.check()?;
        self.net.check()?;
        if let Some(sensor) = &self.sensor {
            let fail =
                |field: &str, what: String| Err(SpecError::new(format!("train.{field}"), what));
            if sensor.rebin != 1 {
                let what = format!(
                    "is {}; bins are summed by train.input.bins: leave it out",
                    sensor.rebin
                );
                return fail("sensor.rebin", what);
            }
            if let Some(field) = sensor.needs_image() {
                let what = "changes the pixels or bins of a whole image, which are kept here: leave it out, or \
                            make a data set with it first by a stage of kind \"reprocess\"";
                return fail(&format!("sensor.{field}"), what.into());
            }
            sensor
                .check()
                .or_else(|SensorError::Invalid { field, what }| fail(&field, what))?;
        }
        self.optimise.check()?;
        let minutes = self.checkpoint_minutes;
        within(
            "train.checkpoint_minutes",
            minutes,
            (0.0, 10_000.0),
            "minutes; 0 is after each step",
        )
    }
}

impl TrainSettings {
    /// Checks the settings of PyTorch.
    fn check_torch(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("train.{field}"), what));
        if self.runtime == Runtime::Torch {
            let parts = self.optimise.accumulate;
            return match parts.is_multiple_of(self.processes) {
                true => Ok(()),
                false => fail(
                    "processes",
                    format!(
                        "is {}, which does not divide optimise.accumulate = {parts}: with runtime = \"torch\" each process has as \
                         many parts of a batch",
                        self.processes
                    ),
                ),
            };
        }
        match self.torch == TorchSettings::default() {
            true => Ok(()),
            false => fail(
                "torch",
                "is for runtime = \"torch\"; set that, or remove it".into(),
            ),
        }
    }

    /// Checks a network that takes the evidence of a demultiplex stage in place of histograms.
    fn check_evidence(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: &str| Err(SpecError::new(format!("train.{field}"), what));
        if self.times().is_none() {
            let what = "is \"truth\", but variant = \"evidence\" takes what a demultiplex stage knows; name one with \
                        demultiplex.evidence = true";
            return fail("shadow.times", what);
        }
        if !matches!(
            self.net.architecture,
            Architecture::Unet2d | Architecture::Swinir
        ) {
            let what = format!(
                "is {:?}, which sees histograms over time; for variant = \"evidence\", take \"unet2d\" or \"swinir\"",
                self.net.architecture.name()
            );
            return fail("net.architecture", &what);
        }
        if self.input != InputSettings::default() {
            let what = "is for histograms, which a network of variant \"evidence\" does not see; remove it";
            return fail("input", what);
        }
        if self.sensor.is_some() {
            let what = "is for histograms, which a network of variant \"evidence\" does not see; let the demultiplex stage \
                        read the output of a sensor";
            return fail("sensor", what);
        }
        Ok(())
    }
}

impl InputSettings {
    fn check(&self) -> Result<(), SpecError> {
        let fail =
            |field: &str, what: String| Err(SpecError::new(format!("train.input.{field}"), what));
        if !(self.max.is_finite() && self.max >= 0.0) {
            return fail("max", format!("{} is no size of a bin", self.max));
        }
        if self.max > 0.0 && self.normalise != Normalise::Log {
            return fail("max", "is for normalise = \"log\"; remove it".into());
        }
        within("train.input.bins", self.bins, (0, 65_536), "bins; 0 is all")
    }
}

impl NetSettings {
    fn check(&self) -> Result<(), SpecError> {
        let fail =
            |field: &str, what: String| Err(SpecError::new(format!("train.net.{field}"), what));
        let limits = [
            ("width", self.width, 1, 1024, "channels"),
            (
                "levels",
                self.levels,
                2,
                8,
                "levels, each half the size of the one before",
            ),
            ("stem", self.stem, 0, 4096, "channels; 0 is none"),
            (
                "time_features",
                self.time_features,
                0,
                4096,
                "bins of time; 0 is none",
            ),
        ];
        for (field, value, low, high, unit) in limits {
            within(format!("train.net.{field}"), value, (low, high), unit)?;
        }
        if self.architecture != Architecture::Unet25d
            && self.time_projection != TimeProjection::Shared
        {
            let what = "is for architecture = \"unet25d\"; remove it".into();
            return fail("time_projection", what);
        }
        if self.stem == 0 && self.stem_form != StemForm::Block {
            let what = "is for a net with a stem; give net.stem (128 in the paper), or remove it";
            return fail("stem_form", what.into());
        }
        if self.architecture != Architecture::Swinir && self.swin != Swin::default() {
            return fail("swin", "is for architecture = \"swinir\"; remove it".into());
        }
        match self.architecture {
            Architecture::Unet2d => self.check_timeless(),
            Architecture::Unet25d => {
                let (time, halved) = (self.time_features, 1 << (self.levels - 1));
                if time == 0 || time % halved != 0 {
                    let what = format!(
                        "{time} must be a multiple of {halved}, so that each of {} levels can halve it (160 in the paper)",
                        self.levels
                    );
                    return fail("time_features", what);
                }
                self.check_stemless()
            }
            Architecture::Embeddings => {
                self.check_timeless()?;
                self.check_stemless()?;
                self.check_flat()
            }
            Architecture::Nlost => {
                self.check_timeless()?;
                self.check_stemless()?;
                self.check_flat()?;
                match self.width.is_multiple_of(4) {
                    true => Ok(()),
                    false => {
                        let what = format!(
                            "{} must be a multiple of 4: heads of attention and scales share it (32 in the released code)",
                            self.width
                        );
                        fail("width", what)
                    }
                }
            }
            Architecture::Swinir => {
                self.check_timeless()?;
                self.check_stemless()?;
                self.check_flat()?;
                self.swin
                    .check(self.width as usize)
                    .or_else(|(field, what)| fail(field, what))
            }
        }
    }

    fn check_timeless(&self) -> Result<(), SpecError> {
        match self.time_features {
            0 => Ok(()),
            _ => Err(SpecError::new(
                "train.net.time_features",
                "is for architecture = \"unet25d\"; remove it",
            )),
        }
    }

    fn check_stemless(&self) -> Result<(), SpecError> {
        match self.stem {
            0 => Ok(()),
            _ => Err(SpecError::new(
                "train.net.stem",
                "is for architecture = \"unet2d\"; remove it",
            )),
        }
    }

    fn check_flat(&self) -> Result<(), SpecError> {
        match self.levels == Self::default().levels {
            true => Ok(()),
            false => Err(SpecError::new(
                "train.net.levels",
                format!(
                    "is for U-Nets; remove it, or set architecture = \"unet2d\" in place of {:?}",
                    self.architecture.name()
                ),
            )),
        }
    }
}

impl OptimiseSettings {
    fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| {
            Err(SpecError::new(format!("train.optimise.{field}"), what))
        };
        let limits = [
            (
                "epochs",
                self.epochs,
                1,
                1_000_000,
                "times that each scene is seen",
            ),
            ("batch", self.batch, 1, 65_536, "scenes a step"),
            (
                "accumulate",
                self.accumulate,
                1,
                self.batch.max(1),
                "parts of a batch",
            ),
            (
                "early_stop",
                self.early_stop,
                0,
                1_000_000,
                "validations; 0 is never",
            ),
            (
                "validate_every",
                self.validate_every,
                0,
                1_000_000_000,
                "steps; 0 is at the end of each epoch only",
            ),
        ];
        for (field, value, low, high, unit) in limits {
            within(format!("train.optimise.{field}"), value, (low, high), unit)?;
        }
        if !self.batch.is_multiple_of(self.accumulate) {
            let what = format!(
                "{} does not divide the batch of {}",
                self.accumulate, self.batch
            );
            return fail("accumulate", what);
        }
        let unit = "(the largest learning rate of AdamW); 0.01 is usual";
        within(
            "train.optimise.learning_rate",
            self.learning_rate,
            (1e-8, 10.0),
            unit,
        )?;
        let unit = "(of AdamW); 0.001 is usual";
        within(
            "train.optimise.weight_decay",
            self.weight_decay,
            (0.0, 0.999),
            unit,
        )?;
        let unit = "(the greatest norm of a step's gradient; 0 is no limit); 1 is usual";
        within("train.optimise.clip_norm", self.clip_norm, (0.0, 1e6), unit)?;
        let unit = "(the decay of an average of the weights; 0 is none); 0.999 is usual";
        within("train.optimise.ema", self.ema, (0.0, 0.999_999), unit)?;
        let RestartSettings { first, factor } = self.restarts;
        let unit = "epochs of the first cycle";
        within("train.optimise.restarts.first", first, (1, 1_000_000), unit)?;
        let unit = "times the length of the cycle before";
        within("train.optimise.restarts.factor", factor, (1, 1000), unit)?;
        if self.restarts != RestartSettings::default() && self.schedule != Schedule::Restarts {
            let what = "is for schedule = \"restarts\"; set that, or remove it".into();
            return fail("restarts", what);
        }
        Ok(())
    }
}

/// Checks the spots that are summed from a histogram.
pub(in crate::spec::kinds) fn check_spots(
    field: &str,
    histogram: Histogram,
    spots: &[u32],
) -> Result<(), SpecError> {
    let fail = |what: String| Err(SpecError::new(field, what));
    // The number of spots of the data set is known only when it is read.
    if let Some(spot) = spots.iter().find(|spot| **spot >= 1024) {
        return fail(format!("{spot} lies outside 0..=1023 (spots count from 0)"));
    }
    match (histogram, spots) {
        (Histogram::TransientSpots, []) => fail(
            "is empty; name the spots to sum, or take histogram = \"transient\" for all".into(),
        ),
        (Histogram::TransientSpots, _) if !spots.is_sorted_by(|a, b| a < b) => {
            fail(format!("{spots:?} must name each once, ascending"))
        }
        (Histogram::TransientSpots, _) | (_, []) => Ok(()),
        (other, _) => fail(format!(
            "are summed from histogram = \"transient_spots\"; remove them from histogram = {:?}",
            other.name()
        )),
    }
}
