//! Layers of networks other than U-Nets: convolutions with a bias, linear layers and norms over
//! channels.

use burn::tensor::{Int, Tensor};

use super::{block::ONE_HOT, pass::Pass};
use crate::{
    ops,
    parameters::{Begin, Declarations, Id},
};

/// The deviation of the normal distribution of initial transformer weights (SwinIR's released
/// code).
const DEVIATION: f32 = 0.02;

/// 3×3 convolution with a bias.
#[derive(Debug, Clone, Copy)]
pub(super) struct Conv {
    weight: Id,
    /// The weight of one-hot channels, which follow the dense ones; in the first layer only.
    one_hot: Option<Id>,
    bias: Id,
}

impl Conv {
    /// Declares a convolution of `inputs` dense and `one_hot` one-hot channels.
    pub(super) fn declare(
        d: &mut Declarations,
        at: &str,
        [inputs, one_hot]: [usize; 2],
        outputs: usize,
    ) -> Self {
        Self::beginning(d, at, [inputs, one_hot], outputs, false)
    }

    /// Declares a convolution that begins with zeros if `zero` is set.
    pub(super) fn beginning(
        d: &mut Declarations,
        at: &str,
        [inputs, one_hot]: [usize; 2],
        outputs: usize,
        zero: bool,
    ) -> Self {
        let begin = match zero {
            true => Begin::Constant(0.0),
            false => Begin::FanIn((inputs + one_hot) * 9),
        };
        let weight = format!("{at}.weight");
        Self {
            weight: d.add(weight.clone(), &[outputs, inputs, 3, 3], begin, true),
            one_hot: (one_hot > 0).then(|| {
                let shape = [outputs, one_hot, 3, 3];
                d.add(format!("{weight}{ONE_HOT}"), &shape, begin, true)
            }),
            bias: d.add(format!("{at}.bias"), &[outputs], begin, true),
        }
    }

    /// Applies the convolution with zero padding.
    pub(super) fn forward(
        &self,
        pass: &Pass,
        x: Tensor<4>,
        one_hot: Option<Tensor<3, Int>>,
    ) -> Tensor<4> {
        let mut y = ops::conv3x3(pass.lower(x), pass.lower(pass.get(self.weight)));
        if let (Some(id), Some(bins)) = (self.one_hot, one_hot) {
            y = y + ops::one_hot_conv3x3(bins, pass.lower(pass.get(id)));
        }
        let bias: Tensor<1> = pass.get(self.bias);
        let channels = bias.dims()[0];
        pass.raise(y) + bias.reshape([1, channels, 1, 1])
    }
}

/// A linear layer over the last dimension.
#[derive(Debug, Clone, Copy)]
pub(super) struct Dense {
    weight: Id,
    bias: Option<Id>,
}

impl Dense {
    /// Declares a layer with a bias and the initialisation of transformers.
    pub(super) fn declare(d: &mut Declarations, at: &str, inputs: usize, outputs: usize) -> Self {
        let begin = [Begin::Normal(DEVIATION), Begin::Constant(0.0)];
        Self::begun(d, at, inputs, outputs, begin)
    }

    /// Declares a layer with a bias and PyTorch's initialisation.
    pub(super) fn usual(d: &mut Declarations, at: &str, inputs: usize, outputs: usize) -> Self {
        Self::begun(d, at, inputs, outputs, [Begin::FanIn(inputs); 2])
    }

    fn begun(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        outputs: usize,
        [weight, bias]: [Begin; 2],
    ) -> Self {
        let this = Self::without_bias(d, at, inputs, outputs, weight);
        Self {
            bias: Some(d.add(format!("{at}.bias"), &[outputs], bias, true)),
            ..this
        }
    }

    pub(super) fn without_bias(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        outputs: usize,
        begin: Begin,
    ) -> Self {
        Self {
            weight: d.add(format!("{at}.weight"), &[outputs, inputs], begin, true),
            bias: None,
        }
    }

    pub(super) fn forward<const D: usize>(&self, pass: &Pass, x: Tensor<D>) -> Tensor<D> {
        let weight: Tensor<2> = pass.get(self.weight);
        let bias = match self.bias {
            Some(id) => pass.get(id),
            None => Tensor::zeros([weight.dims()[0]], &x.device()),
        };
        pass.raise(ops::linear(
            pass.lower(x),
            pass.lower(weight),
            pass.lower(bias),
        ))
    }
}

/// Layer norm over the last dimension.
#[derive(Debug, Clone, Copy)]
pub(super) struct LayerNorm {
    gamma: Id,
    beta: Id,
}

impl LayerNorm {
    pub(super) fn declare(d: &mut Declarations, at: &str, channels: usize) -> Self {
        let mut of = |name: &str, value: f32| {
            let begin = Begin::Constant(value);
            d.add(format!("{at}.{name}"), &[channels], begin, true)
        };
        Self {
            gamma: of("weight", 1.0),
            beta: of("bias", 0.0),
        }
    }

    pub(super) fn forward<const D: usize>(&self, pass: &Pass, x: Tensor<D>) -> Tensor<D> {
        ops::layer_norm(x, pass.get(self.gamma), pass.get(self.beta))
    }
}

/// Declares a learned table of rows with the initialisation of transformers.
pub(super) fn table(d: &mut Declarations, name: String, rows: usize, columns: usize) -> Id {
    d.add(name, &[rows, columns], Begin::Normal(DEVIATION), true)
}
