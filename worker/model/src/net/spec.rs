//! The shape of a network: all settings that determine its parameters, and nothing else.

pub use picofarm_settings::{Architecture, Precision, StemForm, Swin, TimeProjection};
use serde::{Deserialize, Serialize};

use super::network::registered;
use crate::ModelError;

/// The shape of a network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetSpec {
    /// The architecture.
    pub architecture: Architecture,
    /// The number of channels of the dense input: bins and other planes.
    pub dense: usize,
    /// The number of bins of the one-hot input; 0 if there is none.
    pub one_hot: usize,
    /// The number of output channels.
    pub outputs: usize,
    /// For U-Nets, the number of channels of the first level; each further level has twice as many.
    /// For other networks, the number of channels of all features, or of the volume's.
    pub width: usize,
    /// The number of levels of a U-Net's encoder and decoder, the bottleneck included.
    pub levels: usize,
    /// The number of channels of a convolution in front of the first level (the appendix's form:
    /// 128); 0 = none (the released code's form).
    pub stem: usize,
    /// The form of that convolution.
    #[serde(default, skip_serializing_if = "is_default")]
    pub stem_form: StemForm,
    /// For `Unet25d`: the length of the time axis after the first projection (the paper: 160).
    pub time: usize,
    /// For `Unet25d`: whether two streams share that projection.
    #[serde(default, skip_serializing_if = "is_default")]
    pub time_projection: TimeProjection,
    /// For `Swinir`: groups, blocks, heads and windows.
    #[serde(default, skip_serializing_if = "is_default")]
    pub swin: Swin,
    /// Whether the last dense channel is added to the output, and the last layer begins with zeros,
    /// so that an untrained network returns that channel.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub added: bool,
    /// Whether the encoder is fixed, its batch norms included. A decoder is then trained on another
    /// network's features.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub frozen: bool,
    /// The number format of convolutions.
    #[serde(default, skip_serializing_if = "is_default")]
    pub precision: Precision,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl NetSpec {
    /// Returns the shape of the released depth network: 637 bins, 256×256 pixels, 356,404,556
    /// parameters.
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
            added: false,
            frozen: false,
            precision: Precision::F32,
        }
    }

    /// Returns the number of channels of each level, from the finest.
    pub fn widths(&self) -> Vec<usize> {
        (0..self.levels).map(|k| self.width << k).collect()
    }

    /// Returns the required divisor of width and height.
    pub fn multiple(&self) -> usize {
        (registered(self.architecture).multiple)(self).0
    }

    /// Returns the reason for [`Self::multiple`], and the setting that determines it.
    pub fn why_multiple(&self) -> (&'static str, String) {
        let (_, setting, what) = (registered(self.architecture).multiple)(self);
        (setting, what)
    }

    /// Describes the network for reports.
    pub fn describe(&self) -> String {
        (registered(self.architecture).describe)(self)
    }

    /// Returns the number of input streams of networks with a time dimension: the measurement, and
    /// the shadow transient if there is one.
    pub(super) fn streams(&self) -> usize {
        if self.one_hot > 0 { 2 } else { 1 }
    }

    /// Checks that the network can be built.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the field.
    pub fn check(&self) -> Result<(), ModelError> {
        self.check_within("dense", self.dense, 1, 16_384)?;
        self.check_within("one_hot", self.one_hot, 0, 16_384)?;
        self.check_within("outputs", self.outputs, 1, 1_024)?;
        self.check_within("width", self.width, 1, 1_024)?;
        self.check_within("levels", self.levels, 2, 8)?;
        self.check_within("stem", self.stem, 0, 4_096)?;
        let network = registered(self.architecture);
        if network.over_time && self.one_hot != 0 && self.one_hot != self.dense {
            let what = "the two streams of a network over time must have the same bins";
            return Err(ModelError::invalid("net.one_hot", what));
        }
        if self.stem != 0 && !network.has_stem {
            return Err(ModelError::invalid("net.stem", "is for unet2d; remove it"));
        }
        if self.frozen && !network.has_encoder {
            let what = "a frozen encoder with a decoder of its own is for unet2d and unet25d";
            return Err(ModelError::invalid("net.frozen", what));
        }
        if self.added && (!network.adds || self.outputs != 1) {
            let what = "the sum of a channel and one output is for unet2d and swinir";
            return Err(ModelError::invalid("net.added", what));
        }
        (network.check)(self)
    }

    /// Checks that a field lies within its limits.
    #[expect(clippy::unused_self, reason = "as the other checks are called")]
    pub(super) fn check_within(
        &self,
        field: &str,
        value: usize,
        least: usize,
        most: usize,
    ) -> Result<(), ModelError> {
        if (least..=most).contains(&value) {
            return Ok(());
        }
        let what = format!("{value} lies outside {least}..={most}");
        Err(ModelError::invalid(format!("net.{field}"), what))
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
