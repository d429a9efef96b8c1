//! The layers of U-Nets: convolution without bias, batch norm and ReLU (`cbr`), twice in a block.

use burn::tensor::{Int, Tensor};

use super::pass::{Norm, Pass};
use crate::{
    ops,
    parameters::{Begin, Declarations, Id},
};

/// Declares a batch norm over `channels` with PyTorch's names.
pub(super) fn norm(d: &mut Declarations, at: &str, channels: usize) -> Norm {
    let one = |d: &mut Declarations, name: &str, value: f32, learned: bool| {
        d.add(
            format!("{at}.{name}"),
            &[channels],
            Begin::Constant(value),
            learned,
        )
    };
    Norm {
        gamma: one(d, "weight", 1.0, true),
        beta: one(d, "bias", 0.0, true),
        mean: one(d, "running_mean", 0.0, false),
        variance: one(d, "running_var", 1.0, false),
        batches: d.add(
            format!("{at}.num_batches_tracked"),
            &[1],
            Begin::Constant(0.0),
            false,
        ),
    }
}

/// 3×3 convolution, batch norm, ReLU.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cbr {
    weight: Id,
    /// The weight of one-hot channels, which follow the dense ones; in the first layer only.
    one_hot: Option<Id>,
    norm: Norm,
}

impl Cbr {
    /// Declares a layer with `inputs` dense and `one_hot` one-hot channels.
    pub(super) fn declare(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        one_hot: usize,
        outputs: usize,
    ) -> Self {
        let begin = Begin::FanIn((inputs + one_hot) * 9);
        let name = format!("{at}.conv.weight");
        let weight = d.add(name.clone(), &[outputs, inputs, 3, 3], begin, true);
        let one_hot = (one_hot > 0).then(|| {
            // PyTorch has one tensor for both; the two are joined when weights are written.
            d.add(
                format!("{name}{ONE_HOT}"),
                &[outputs, one_hot, 3, 3],
                begin,
                true,
            )
        });
        Self {
            weight,
            one_hot,
            norm: norm(d, &format!("{at}.batchnorm"), outputs),
        }
    }

    pub(super) fn forward(
        &self,
        pass: &mut Pass,
        x: Tensor<4>,
        one_hot: Option<&Tensor<3, Int>>,
    ) -> Tensor<4> {
        let mut y = ops::conv3x3(pass.lower(x), pass.lower(pass.get(self.weight)));
        if let (Some(id), Some(bins)) = (self.one_hot, one_hot) {
            y = y + ops::one_hot_conv3x3(bins.clone(), pass.lower(pass.get(id)));
        }
        let y = pass.raise(y);
        pass.norm_relu(&self.norm, y)
    }
}

/// The suffix of the names of weights that belong to one-hot channels.
pub const ONE_HOT: &str = ".one_hot";

/// Two [`Cbr`] layers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block([Cbr; 2]);

impl Block {
    /// Declares an encoder block. Its first layer has at least half of the output's channels
    /// (released code: `DoubleConv`).
    pub(super) fn encoder(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        one_hot: usize,
        outputs: usize,
    ) -> Self {
        let between = (outputs / 2).max(inputs + one_hot);
        Self::declare(d, at, inputs, one_hot, between, outputs)
    }

    /// Declares a decoder block. Both layers have the output's channels.
    pub(super) fn decoder(d: &mut Declarations, at: &str, inputs: usize, outputs: usize) -> Self {
        Self::declare(d, at, inputs, 0, outputs, outputs)
    }

    fn declare(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        one_hot: usize,
        between: usize,
        outputs: usize,
    ) -> Self {
        let name = |i| format!("{at}.basic_module.SingleConv{i}");
        Self([
            Cbr::declare(d, &name(1), inputs, one_hot, between),
            Cbr::declare(d, &name(2), between, 0, outputs),
        ])
    }

    pub(super) fn forward(
        &self,
        pass: &mut Pass,
        x: Tensor<4>,
        one_hot: Option<&Tensor<3, Int>>,
    ) -> Tensor<4> {
        let [first, second] = &self.0;
        let x = first.forward(pass, x, one_hot);
        second.forward(pass, x, None)
    }
}

/// A linear layer over channels: weights (outputs, inputs) and a bias.
#[derive(Debug, Clone, Copy)]
pub(super) struct Linear {
    weight: Id,
    bias: Id,
}

impl Linear {
    pub(super) fn declare(d: &mut Declarations, at: &str, shape: &[usize]) -> Self {
        let begin = Begin::FanIn(shape[1]);
        Self {
            weight: d.add(format!("{at}.weight"), shape, begin, true),
            bias: d.add(format!("{at}.bias"), &shape[..1], begin, true),
        }
    }

    /// Returns the number of input channels.
    pub(super) fn inputs(&self, pass: &Pass) -> usize {
        pass.declared(self.weight).shape[1]
    }

    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>) -> Tensor<4> {
        let bias: Tensor<1> = pass.get(self.bias);
        let (outputs, inputs) = (bias.dims()[0], x.dims()[1]);
        let weight = pass.flat(self.weight).reshape([outputs, inputs, 1, 1]);
        pass.raise(ops::conv1x1(
            pass.lower(x),
            pass.lower(weight),
            pass.lower(bias),
        ))
    }

    /// Applies the layer to one-hot channels.
    pub(super) fn one_hot(&self, pass: &Pass, bins: Tensor<3, Int>) -> Tensor<4> {
        let bias: Tensor<1> = pass.get(self.bias);
        let [outputs, inputs] = [bias.dims()[0], self.inputs(pass)];
        let weight = pass.flat(self.weight).reshape([outputs, inputs, 1, 1]);
        pass.raise(ops::one_hot_conv1x1(
            bins,
            pass.lower(weight),
            pass.lower(bias),
        ))
    }
}

/// The last layer: 1×1 convolution with a bias.
#[derive(Debug, Clone, Copy)]
pub(super) struct Final {
    weight: Id,
    bias: Id,
}

impl Final {
    /// Declares the layer. With `zero` it begins with zeros.
    pub(super) fn declare(d: &mut Declarations, inputs: usize, outputs: usize, zero: bool) -> Self {
        let begin = match zero {
            true => Begin::Constant(0.0),
            false => Begin::FanIn(inputs),
        };
        Self {
            weight: d.add(
                "final_conv.weight".into(),
                &[outputs, inputs, 1, 1],
                begin,
                true,
            ),
            bias: d.add("final_conv.bias".into(), &[outputs], begin, true),
        }
    }

    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>) -> Tensor<4> {
        let [x, weight] = [x, pass.get(self.weight)].map(|t| pass.lower(t));
        pass.raise(ops::conv1x1(x, weight, pass.lower(pass.get(self.bias))))
    }
}
