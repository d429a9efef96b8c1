//! The 2.5D U-Net of Shoot-Bounce-3D: time is a dimension of the encoder, and the decoder is
//! two-dimensional.
//!
//! Features are stored as (N·T, C, H, W), one image for each moment. A 3×3×3 convolution is then a
//! 3×3 convolution over the concatenated channels of three moments, batch norm over images includes
//! time, and a projection of time is a 1×1 convolution. All layers therefore use the operations of
//! the 2D network.

use burn::tensor::{Tensor, activation::relu};

use super::{
    block::{Linear, norm},
    network::Network,
    pass::{Input, Norm, Pass},
    spec::{NetSpec, TimeProjection},
    unet2d::{Decoder, hand_on, is_bottleneck},
};
use crate::{
    ModelError, ops,
    parameters::{Begin, Declarations, Id},
};

#[derive(Debug, Clone)]
pub(super) struct Unet25d {
    time: usize,
    /// The projections of bins to moments: one for both streams (the released code's form), or one
    /// for each.
    projections: Vec<Linear>,
    encoders: Vec<[Cbr; 2]>,
    /// The projections of each level's moments to one.
    skips: Vec<Vec<Linear>>,
    frozen: bool,
    decoder: Decoder,
}

/// 3×3×3 convolution without bias, batch norm, ReLU.
#[derive(Debug, Clone, Copy)]
struct Cbr {
    weight: Id,
    norm: Norm,
}

impl Unet25d {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        let streams = spec.streams();
        d.frozen = spec.frozen;
        let shape = [spec.time, spec.dense, 1, 1];
        let projections = match spec.time_projection {
            TimeProjection::Shared => vec![Linear::declare(d, "time_projection", &shape)],
            TimeProjection::Each => (0..streams)
                .map(|s| Linear::declare(d, &format!("time_projections.{s}"), &shape))
                .collect(),
        };
        let mut inputs = streams;
        let mut encoders = Vec::new();
        for (i, outputs) in spec.widths().into_iter().enumerate() {
            if is_bottleneck(i, spec.levels) && !spec.frozen {
                d.cut();
            }
            let at = |k| format!("encoders.{i}.basic_module.SingleConv{k}");
            let between = (outputs / 2).max(inputs);
            encoders.push([
                Cbr::declare(d, &at(1), inputs, between),
                Cbr::declare(d, &at(2), between, outputs),
            ]);
            inputs = outputs;
        }
        if !spec.frozen {
            d.cut();
        }
        d.frozen = false;
        let skips = (0..spec.levels)
            .map(|level| {
                let sizes = steps(spec.time >> level);
                let pairs = sizes.iter().zip(&sizes[1..]).enumerate();
                pairs
                    .map(|(k, (from, to))| {
                        // PyTorch counts the activations between the layers as modules.
                        let at = format!("skip_projections.{level}.{}", 2 * k);
                        Linear::declare(d, &at, &[*to, *from])
                    })
                    .collect()
            })
            .collect();
        Self {
            time: spec.time,
            projections,
            encoders,
            skips,
            frozen: spec.frozen,
            decoder: Decoder::declare(d, spec),
        }
    }

    pub(super) fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        let features = match self.frozen {
            true => pass.frozen(|pass| self.features(pass, input, true)),
            false => self.features(pass, input, false),
        };
        let levels = features.into_iter().zip(&self.skips).enumerate();
        let flat = levels
            .map(|(level, (x, skip))| project(pass, x, self.time >> level, skip))
            .collect();
        self.decoder.forward(pass, flat)
    }

    /// Returns the encoder's features at each level, (N·T, C, H, W), from the finest.
    fn features(&self, pass: &mut Pass, input: Input, frozen: bool) -> Vec<Tensor<4>> {
        let [n, _, h, w] = input.dense.dims();
        // A shared projection is both the first and the last.
        let (Some(of_dense), Some(of_one_hot)) =
            (self.projections.first(), self.projections.last())
        else {
            unreachable!("a network has a projection")
        };
        let mut streams = vec![of_dense.forward(pass, input.dense)];
        if let Some(bins) = input.one_hot {
            streams.push(of_one_hot.one_hot(pass, bins));
        }
        let moments = |x: Tensor<4>| x.reshape([n, self.time, 1, h, w]);
        let streams: Vec<Tensor<5>> = streams.into_iter().map(moments).collect();
        let channels = streams.len();
        let mut x = Tensor::cat(streams, 2).reshape([n * self.time, channels, h, w]);
        let mut features = Vec::new();
        for (level, block) in self.encoders.iter().enumerate() {
            if level > 0 {
                x = ops::halve_time(ops::max_pool(x));
            }
            for cbr in block {
                x = cbr.forward(pass, x, self.time >> level);
            }
            let (kept, next) = match frozen {
                true => (x.clone(), x),
                false => hand_on(pass, level, self.encoders.len(), x),
            };
            features.push(kept);
            x = next;
        }
        features
    }
}

impl Network for Unet25d {
    const HAS_ENCODER: bool = true;
    const OVER_TIME: bool = true;

    fn build(d: &mut Declarations, spec: &NetSpec) -> Self {
        Self::declare(d, spec)
    }

    fn multiple(spec: &NetSpec) -> (usize, &'static str, String) {
        let what = format!("{} halve the image {} times", spec.levels, spec.levels - 1);
        (1 << (spec.levels - 1), "net.levels", what)
    }

    fn check(spec: &NetSpec) -> Result<(), ModelError> {
        spec.check_within("time", spec.time, 1, 4_096)?;
        let divisor = 1 << (spec.levels - 1);
        if spec.time.is_multiple_of(divisor) {
            return Ok(());
        }
        let what = format!(
            "{} must be a multiple of {divisor}: it is halved {} times (levels - 1)",
            spec.time,
            spec.levels - 1
        );
        Err(ModelError::invalid("net.time_features", what))
    }

    fn multiply_adds(spec: &NetSpec, side: usize) -> f64 {
        let streams = spec.streams();
        let mut sum = (streams * spec.dense * spec.time * side * side) as f64;
        let mut inputs = streams;
        for (level, width) in spec.widths().into_iter().enumerate() {
            let (pixels, time) = ((side >> level).pow(2), spec.time >> level);
            let between = inputs.max(width / 2);
            sum += (27 * (inputs + width) * between * pixels * time) as f64;
            let sizes = steps(time);
            let over_time: usize = sizes.windows(2).map(|pair| pair[0] * pair[1]).sum();
            sum += (over_time * width * pixels) as f64;
            inputs = width;
        }
        sum + spec.of_decoder(side)
    }

    fn describe(spec: &NetSpec) -> String {
        format!("2.5D U-Net, width {}, {} levels", spec.width, spec.levels)
    }

    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        Self::forward(self, pass, input)
    }
}

/// Maps (N·T, C, H, W) to (N, C, H, W) through layers over time, with ReLU between them.
fn project(pass: &Pass, x: Tensor<4>, time: usize, layers: &[Linear]) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let n = images / time;
    let mut x = x.reshape([n, time, c * h, w]);
    for (k, layer) in layers.iter().enumerate() {
        if k > 0 {
            x = relu(x);
        }
        x = layer.forward(pass, x);
    }
    x.reshape([n, c, h, w])
}

/// Returns the sizes from a level's moments to one: 160-128-32-1, 80-64-32-1, 40-32-1, 20-16-1 (the
/// appendix). Other numbers follow the same rule: the greatest power of two below, then 32 if the
/// power is greater, then one.
pub(super) fn steps(time: usize) -> Vec<usize> {
    let mut sizes = vec![time];
    if time > 2 {
        let power = (time - 1).ilog2();
        sizes.push(1 << power);
        if power > 5 {
            sizes.push(32);
        }
    }
    sizes.push(1);
    sizes
}

impl Cbr {
    fn declare(d: &mut Declarations, at: &str, inputs: usize, outputs: usize) -> Self {
        let begin = Begin::FanIn(inputs * 27);
        let shape = [outputs, inputs, 3, 3, 3];
        Self {
            weight: d.add(format!("{at}.conv.weight"), &shape, begin, true),
            norm: norm(d, &format!("{at}.batchnorm"), outputs),
        }
    }

    fn forward(&self, pass: &mut Pass, x: Tensor<4>, time: usize) -> Tensor<4> {
        let c = x.dims()[1];
        let beside = ops::adjacent(x, time);
        let weight: Tensor<5> = pass.get(self.weight);
        let outputs = weight.dims()[0];
        let weight = weight.swap_dims(1, 2).reshape([outputs, 3 * c, 3, 3]);
        let y = pass.raise(ops::conv3x3(pass.lower(beside), pass.lower(weight)));
        pass.norm_relu(&self.norm, y)
    }
}

#[cfg(test)]
mod tests {
    use super::steps;

    #[test]
    fn the_papers_projections() {
        assert_eq!(steps(160), [160, 128, 32, 1]);
        assert_eq!(steps(80), [80, 64, 32, 1]);
        assert_eq!(steps(40), [40, 32, 1]);
        assert_eq!(steps(20), [20, 16, 1]);
        assert_eq!(
            (steps(1), steps(2), steps(3)),
            (vec![1, 1], vec![2, 1], vec![3, 2, 1])
        );
    }
}
