//! What a network looks like: everything that decides its parameters, and nothing else.

pub use picofarm_settings::{Architecture, Precision, StemForm, Swin, TimeProjection};
use serde::{Deserialize, Serialize};

use super::nlost;
use crate::ModelError;

/// Shape of a network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetSpec {
    /// Which one.
    pub architecture: Architecture,
    /// Channels of the dense input: bins, and planes that say something else.
    pub dense: usize,
    /// Bins of the one-hot input; 0 where there is none.
    pub one_hot: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Channels of a U-Net's first level; each further one has twice as many. Of the others the channels of all features, or of the
    /// volume's.
    pub width: usize,
    /// Levels of a U-Net's encoder and decoder, the bottleneck among them.
    pub levels: usize,
    /// Channels of a convolution before the first level (the appendix's form: 128); 0 = none (the released code's).
    pub stem: usize,
    /// What that convolution is.
    #[serde(default, skip_serializing_if = "is_default")]
    pub stem_form: StemForm,
    /// Length of the time axis after the first projection, `Unet25d` only (the paper: 160).
    pub time: usize,
    /// Whether two streams share that projection, `Unet25d` only.
    #[serde(default, skip_serializing_if = "is_default")]
    pub time_projection: TimeProjection,
    /// Groups, blocks, heads and windows, `Swinir` only.
    #[serde(default, skip_serializing_if = "is_default")]
    pub swin: Swin,
    /// The encoder stays as it is, its batch norms too: a decoder learns on another network's features.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub frozen: bool,
    /// Numbers in which convolutions are computed.
    #[serde(default, skip_serializing_if = "is_default")]
    pub precision: Precision,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl NetSpec {
    /// The released depth network: 637 bins, 256×256 pixels, 356,404,556 parameters.
    pub fn released(dense: usize, one_hot: usize, outputs: usize) -> Self {
        Self {
            architecture: Architecture::Unet2d,
            dense,
            one_hot,
            outputs,
            width: 128,
            levels: 6,
            stem: 0,
            stem_form: StemForm::Block,
            time: 160,
            time_projection: TimeProjection::Shared,
            swin: Swin::default(),
            frozen: false,
            precision: Precision::F32,
        }
    }

    /// Channels of each level, from the finest.
    pub fn widths(&self) -> Vec<usize> {
        (0..self.levels).map(|k| self.width << k).collect()
    }

    /// Width and height must be multiples of this.
    pub fn multiple(&self) -> usize {
        match self.architecture {
            Architecture::Unet2d | Architecture::Unet25d => 1 << (self.levels - 1),
            Architecture::Swinir => self.swin.window as usize,
            Architecture::Embeddings => 2,
            Architecture::Nlost => 2 * nlost::WINDOW,
        }
    }

    /// Why, and the setting that says so.
    pub fn why_multiple(&self) -> (&'static str, String) {
        match self.architecture {
            Architecture::Unet2d | Architecture::Unet25d => {
                let what = format!("{} halve the image {} times", self.levels, self.levels - 1);
                ("net.levels", what)
            }
            Architecture::Swinir => {
                let what = format!("windows have {0}×{0} pixels", self.swin.window);
                ("net.swin.window", what)
            }
            Architecture::Embeddings => ("net.architecture", "embeddings halve the image".into()),
            Architecture::Nlost => {
                let what = format!(
                    "nlost halves the image, and windows have {0}×{0} pixels of that",
                    nlost::WINDOW
                );
                ("net.architecture", what)
            }
        }
    }

    /// Measurement, and shadow transient where there is one, of networks in which time is a dimension.
    pub(super) fn streams(&self) -> usize {
        if self.one_hot > 0 { 2 } else { 1 }
    }

    /// Checks what can be built.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the field.
    pub fn check(&self) -> Result<(), ModelError> {
        let within = |field: &str, value: usize, least: usize, most: usize| {
            if (least..=most).contains(&value) {
                return Ok(());
            }
            let what = format!("{value} lies outside {least}..={most}");
            Err(ModelError::invalid(format!("net.{field}"), what))
        };
        within("dense", self.dense, 1, 16_384)?;
        within("one_hot", self.one_hot, 0, 16_384)?;
        within("outputs", self.outputs, 1, 1_024)?;
        within("width", self.width, 1, 1_024)?;
        within("levels", self.levels, 2, 8)?;
        within("stem", self.stem, 0, 4_096)?;
        if self.architecture == Architecture::Unet25d {
            within("time", self.time, 1, 4_096)?;
            let divisor = 1 << (self.levels - 1);
            if !self.time.is_multiple_of(divisor) {
                let what = format!(
                    "{} must be a multiple of {divisor}: it is halved {} times (levels - 1)",
                    self.time,
                    self.levels - 1
                );
                return Err(ModelError::invalid("net.time_features", what));
            }
            if self.stem != 0 {
                return Err(ModelError::invalid("net.stem", "is for unet2d; remove it"));
            }
        }
        let timed = matches!(
            self.architecture,
            Architecture::Unet25d | Architecture::Embeddings | Architecture::Nlost
        );
        if timed && self.one_hot != 0 && self.one_hot != self.dense {
            let what = "the two streams of a network over time must have the same bins";
            return Err(ModelError::invalid("net.one_hot", what));
        }
        self.check_other()
    }

    /// What networks that are no U-Nets lack or need.
    fn check_other(&self) -> Result<(), ModelError> {
        if matches!(
            self.architecture,
            Architecture::Unet2d | Architecture::Unet25d
        ) {
            return Ok(());
        }
        if self.stem != 0 {
            return Err(ModelError::invalid("net.stem", "is for unet2d; remove it"));
        }
        if self.frozen {
            let what = "a frozen encoder with a decoder of its own is for unet2d and unet25d";
            return Err(ModelError::invalid("net.frozen", what));
        }
        if self.architecture == Architecture::Nlost && !self.width.is_multiple_of(nlost::HEADS) {
            let what = format!(
                "{} must be a multiple of {}: heads and scales share it",
                self.width,
                nlost::HEADS
            );
            return Err(ModelError::invalid("net.width", what));
        }
        if self.architecture == Architecture::Swinir {
            self.swin
                .check(self.width)
                .map_err(|(field, what)| ModelError::invalid(format!("net.{field}"), what))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::NetSpec;

    #[test]
    fn the_released_networks_take_half_and_one_and_a_quarter_million_million_multiply_adds() {
        let tera = |one_hot| NetSpec::released(637, one_hot, 1).multiply_adds(256) / 1e12;
        assert!((tera(0) - 0.517).abs() < 1e-3, "{}", tera(0));
        assert!((tera(637) - 1.283).abs() < 1e-3, "{}", tera(637));
    }
}
