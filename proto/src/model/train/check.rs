//! What a training's settings may be.

use super::{
    Architecture, InputSettings, NetSettings, Normalise, OptimiseSettings, ShadowSettings, Target,
    TrainSettings, TrainTask,
};
use crate::model::{
    job::{SpecError, check_count, check_source},
    reprocess::Histogram,
};

impl TrainTask {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.train.check()
    }
}

impl TrainSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
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
        if self.task != Target::Shadow && self.shadow != ShadowSettings::default() {
            return fail(
                "shadow",
                format!("is not for task = {:?}; remove it", self.task.name()),
            );
        }
        if self.task != Target::Specular && !self.specular.on.is_empty() {
            return fail(
                "specular",
                format!("is not for task = {:?}; remove it", self.task.name()),
            );
        }
        if !self.specular.on.is_empty() && !self.from.is_empty() {
            let what = "is not for a network on the features of another (train.specular.on); remove one of them";
            return fail("from", what.into());
        }
        if self.shadow.tof.is_empty() {
            let what = "is empty; give \"truth\" or a trained ToF model".into();
            return fail("shadow.tof", what);
        }
        if let Some(trial) = &self.trial {
            trial.check()?;
        }
        self.input.check()?;
        self.net.check()?;
        self.optimise.check()?;
        if !(0.01..=10_000.0).contains(&self.checkpoint_minutes) {
            let what = format!("{} lies outside 0.01..=10000", self.checkpoint_minutes);
            return fail("checkpoint_minutes", what);
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
        if self.bins > 65_536 {
            return fail("bins", format!("{} lies outside 0..=65536", self.bins));
        }
        Ok(())
    }
}

impl NetSettings {
    fn check(&self) -> Result<(), SpecError> {
        let fail =
            |field: &str, what: String| Err(SpecError::new(format!("train.net.{field}"), what));
        let limits = [
            ("width", self.width, 1, 1024),
            ("levels", self.levels, 2, 8),
            ("stem", self.stem, 0, 4096),
            ("time_features", self.time_features, 0, 4096),
        ];
        for (field, value, low, high) in limits {
            if !(low..=high).contains(&value) {
                return fail(field, format!("{value} lies outside {low}..={high}"));
            }
        }
        match (self.architecture, self.time_features) {
            (Architecture::Unet2d, 1..) => fail(
                "time_features",
                "is for architecture = \"unet25d\"; remove it".into(),
            ),
            (Architecture::Unet25d, t) if t == 0 || t % (1 << (self.levels - 1)) != 0 => fail(
                "time_features",
                format!(
                    "{t} must be a multiple of {}, so that each of {} levels can halve it (160 in the paper)",
                    1 << (self.levels - 1),
                    self.levels
                ),
            ),
            (Architecture::Unet25d, _) if self.stem > 0 => {
                fail("stem", "is for architecture = \"unet2d\"; remove it".into())
            }
            _ => Ok(()),
        }
    }
}

impl OptimiseSettings {
    fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| {
            Err(SpecError::new(format!("train.optimise.{field}"), what))
        };
        let limits = [
            ("epochs", self.epochs, 1, 1_000_000),
            ("batch", self.batch, 1, 65_536),
            ("accumulate", self.accumulate, 1, self.batch.max(1)),
        ];
        for (field, value, low, high) in limits {
            if !(low..=high).contains(&value) {
                return fail(field, format!("{value} lies outside {low}..={high}"));
            }
        }
        if !self.batch.is_multiple_of(self.accumulate) {
            let what = format!(
                "{} does not divide the batch of {}",
                self.accumulate, self.batch
            );
            return fail("accumulate", what);
        }
        if !(self.rate > 0.0 && self.rate <= 10.0) {
            return fail(
                "rate",
                format!("{} lies outside 0..=10, 0 not included", self.rate),
            );
        }
        if !(0.0..1.0).contains(&self.weight_decay) {
            return fail(
                "weight_decay",
                format!("{} lies outside 0..1, 1 not included", self.weight_decay),
            );
        }
        Ok(())
    }
}

/// Checks the name of a model: it is a folder's.
///
/// # Errors
/// [`SpecError`] naming the field.
pub fn check_model(field: &str, name: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if (1..=128).contains(&name.len()) && !name.starts_with('.') && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!(
        "{name:?} must be up to 128 letters, digits, '-', '_' and '.', and not begin with '.'"
    );
    Err(SpecError::new(field, what))
}

pub(in crate::model) fn check_split(field: &str, name: &str) -> Result<(), SpecError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    if (1..=64).contains(&name.len()) && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!("{name:?} must be up to 64 letters, digits, '-' and '_'");
    Err(SpecError::new(field, what))
}

pub(in crate::model) fn check_spots(
    field: &str,
    histogram: Histogram,
    spots: &[u32],
) -> Result<(), SpecError> {
    let fail = |what: String| Err(SpecError::new(field, what));
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
