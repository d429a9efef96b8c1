//! NLOST (Li et al., "NLOST: Non-line-of-sight imaging with transformer", CVPR 2023; released
//! code): a volume of features, local and global attention in it, and the output images of learned
//! feature embeddings. The names of its parameters are the released code's.
//!
//! It differs from the released code as follows:
//! - The volume has half of the input's rows and columns, as in learned feature embeddings. An
//!   input of 256² therefore gives the 128² of the released code, and the output is doubled again.
//!   The released code transforms light between the two parts of the volume, for confocal scans of
//!   a wall; here this step is the identity. Of its two outputs, intensity and depth, only the
//!   learned one exists.
//! - Attention over time has a bias for each difference of moments. The released code treats 16
//!   moments as pixels of a 4×4 window.
//! - The released code moves features of one place to another when it exchanges axes (after
//!   attention over time in the global encoder, and after both sums of the decoders). Here places
//!   do not change.
//! - The scale of the decoders' first norm is initially 1. In the released code it is initially 0,
//!   like the second one. Neither scale then ever has a gradient, and the layers between the norms
//!   are not learned.

mod attention;

use burn::tensor::{Tensor, activation::relu};

use super::{
    downsample::{BOX, Downsample},
    network::Network,
    pass::{Input, Pass},
    rendering::{Rendering, by_channel, normalised},
    residual::{Residual, SLOPE},
    spec::NetSpec,
    volume::{self, Seen},
};
use crate::{
    ModelError, ops,
    parameters::{Begin, Declarations, Id},
};
use attention::{Decoder, Encoder};

/// The number of features of the first volume that convolutions compute, in addition to the
/// filtered ones.
const FIRST: usize = 3;
/// The number of attention heads.
pub(super) const HEADS: usize = 4;
/// The number of rows and columns of a window of the local encoder: the released code's at 128².
const WINDOW: usize = 16;
/// The ratio of the channels between the two layers of a perceptron to those of the features.
pub(super) const BETWEEN: usize = 4;

/// Returns the number of feature groups that the decoders sum separately.
pub(super) fn groups(width: usize) -> usize {
    if width.is_multiple_of(8) { 8 } else { 4 }
}

/// Returns the number of moments of the volume, first of the input and then after each part that
/// halves it.
pub(super) fn moments(bins: usize) -> [usize; 5] {
    let mut time = bins;
    [(); 5].map(|()| {
        time = time.div_ceil(2);
        time
    })
}

#[derive(Debug, Clone)]
pub(super) struct Nlost {
    first: Downsample,
    /// The kernels: stride 2, stride 2 with gaps, 3×3×3 of the latter, and with gaps of the first.
    scales: [Kernel; 4],
    /// The third part that halves time: a filter, with convolutions in parallel.
    filter: Id,
    halved: Kernel,
    blocks: [Residual; 2],
    embedded: [Kernel; 2],
    fused: Kernel,
    coarse: Kernel,
    positions: [Kernel; 2],
    local: Encoder,
    global: Encoder,
    upwards: Kernel,
    decoders: [Decoder; 2],
    over_time: [[Kernel; 3]; 2],
    joined: [Kernel; 2],
    depth: Rendering,
}

/// The parameters of a convolution.
#[derive(Debug, Clone, Copy)]
struct Kernel {
    weight: Id,
    bias: Option<Id>,
}

impl Kernel {
    /// Declares weights with a normal distribution that preserves deviations through ReLU (He et
    /// al., 2015) for `taps` taps, without a bias.
    fn declare(d: &mut Declarations, at: &str, shape: [usize; 5], taps: usize) -> Self {
        let begin = Begin::Normal((2.0 / taps as f32).sqrt());
        Self::begun(d, at, shape, begin)
    }

    fn begun(d: &mut Declarations, at: &str, shape: [usize; 5], begin: Begin) -> Self {
        Self {
            weight: d.add(format!("{at}.weight"), &shape, begin, true),
            bias: None,
        }
    }

    /// Declares weights and a bias with PyTorch's initialisation.
    fn usual(d: &mut Declarations, at: &str, shape: [usize; 5]) -> Self {
        let begin = Begin::FanIn(shape[1..].iter().product());
        let this = Self::begun(d, at, shape, begin);
        this.with_bias(d, at, shape[0], begin)
    }

    fn with_bias(self, d: &mut Declarations, at: &str, outputs: usize, begin: Begin) -> Self {
        Self {
            bias: Some(d.add(format!("{at}.bias"), &[outputs], begin, true)),
            ..self
        }
    }

    fn weight(&self, pass: &Pass) -> Tensor<5> {
        pass.get(self.weight)
    }

    /// Adds the bias to a convolution's output.
    fn biased(&self, pass: &Pass, y: Tensor<4>) -> Tensor<4> {
        match self.bias {
            None => y,
            Some(bias) => {
                let bias: Tensor<1> = pass.get(bias);
                let channels = bias.dims()[0];
                y + bias.reshape([1, channels, 1, 1])
            }
        }
    }
}

/// Three consecutive moments.
const fn three(stride: usize) -> Seen {
    Seen {
        taps: 3,
        apart: 1,
        stride,
    }
}

/// Three moments, every second one.
const fn gaps(stride: usize) -> Seen {
    Seen {
        taps: 3,
        apart: 2,
        stride,
    }
}

/// Five moments, with stride 2.
const FIVE: Seen = Seen {
    taps: 5,
    apart: 1,
    stride: 2,
};

impl Nlost {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        let (streams, c) = (spec.streams(), spec.width);
        let features = streams + FIRST;
        let zero = Begin::Constant(0.0);
        let first = Downsample::declare(d, "sig_expand", streams, FIRST);
        let part = c / 4;
        let scale = |d: &mut Declarations, k: usize, inputs: usize| {
            let at = format!("msfeat.conv{k}.0");
            Kernel::declare(d, &at, [part, inputs, 3, 3, 3], 27 * inputs)
                .with_bias(d, &at, part, zero)
        };
        let scales = [
            scale(d, 1, features),
            scale(d, 2, features),
            scale(d, 3, part),
            scale(d, 4, part),
        ];
        let mean = Begin::Repeated(&BOX, 1.0 / (c * c) as f32);
        let filter = d.add("sig_feat.weights".into(), &[c, c, 3, 3, 3], mean, true);
        let halved = Kernel::usual(d, "sig_feat.conv1.1", [c, c, 3, 3, 3]);
        let blocks = [2, 3].map(|k| Residual::declare(d, &format!("sig_feat.conv1.{k}"), c, true));
        let embedded = [
            Kernel::declare(d, "dsfusion.ds.0", [c, c, 5, 5, 5], 125 * c).with_bias(
                d,
                "dsfusion.ds.0",
                c,
                zero,
            ),
            Kernel::usual(d, "dsfusion.ds.2", [c, c, 5, 5, 5]),
        ];
        let fused = Kernel::declare(d, "dsfusion.fusion.0", [c, c, 1, 1, 1], c).with_bias(
            d,
            "dsfusion.fusion.0",
            c,
            zero,
        );
        // The released code uses a uniform distribution with the same deviation.
        let coarse = Kernel::declare(d, "spds.dsop.0", [c, c, 5, 5, 5], 125 * c).with_bias(
            d,
            "spds.dsop.0",
            c,
            zero,
        );
        let positions = ["posenc_l.proj", "posenc_g.proj"]
            .map(|at| Kernel::declare(d, at, [c, c, 3, 3, 3], 27 * c).with_bias(d, at, c, zero));
        let time = moments(spec.dense)[4];
        let local = Encoder::declare(d, "loc_encds.0", c, Some(time));
        let global = Encoder::declare(d, "glb_encds.0", c, None);
        let upwards = Kernel::declare(
            d,
            "locglb_inte.upop_G.upop.0.0",
            [c, c, 3, 6, 6],
            // The taps of the outputs, as PyTorch counts them for transposed convolutions.
            108 * c,
        );
        let decoders = ["locglb_inte.loc_decs.0", "locglb_inte.glb_decs.0"]
            .map(|at| Decoder::declare(d, at, c));
        let over_time = ["inte_rec.tmup1.temup", "inte_rec.tmup2.temup"].map(|at| {
            let shape = |inputs, outputs| [inputs, outputs, 6, 3, 3];
            let he = |d: &mut Declarations, k: usize, inputs: usize, outputs: usize| {
                Kernel::declare(
                    d,
                    &format!("{at}.{k}.0"),
                    shape(inputs, outputs),
                    54 * outputs,
                )
            };
            [
                he(d, 0, c, c / 2),
                he(d, 1, c / 2, c / 4),
                Kernel::begun(
                    d,
                    &format!("{at}.2.0"),
                    shape(c / 4, c),
                    Begin::Normal(1e-3),
                ),
            ]
        });
        let joined = [
            Kernel::usual(d, "inte_rec.fuse.0", [c, 3 * c, 3, 3, 3]),
            Kernel::usual(d, "inte_rec.fuse.2", [features, c, 3, 3, 3]),
        ];
        Self {
            first,
            scales,
            filter,
            halved,
            blocks,
            embedded,
            fused,
            coarse,
            positions,
            local,
            global,
            upwards,
            decoders,
            over_time,
            joined,
            depth: Rendering::declare(d, "dep_refine", features, spec.outputs),
        }
    }

    pub(super) fn forward(&self, pass: &Pass, input: Input) -> Tensor<4> {
        let (x, time) = self.first.forward(pass, input);
        let [images, channels, h, w] = x.dims();
        let n = images / time;
        let x = normalised(by_channel(x, time))
            .swap_dims(1, 2)
            .reshape([images, channels, h, w]);

        let (shallow, second) = self.scales(pass, x, time);
        let (x, third) = self.halved(pass, shallow.clone(), second);
        let (fine, time) = self.embedded(pass, x, third);
        let coarse = volume::conv5_halved(pass, fine.clone(), time, self.coarse.weight(pass));
        let coarse = relu(self.coarse.biased(pass, coarse));

        let placed = |x: Tensor<4>, of: &Kernel| {
            let place = volume::conv(pass, x.clone(), time, of.weight(pass), three(1));
            tokens(x + of.biased(pass, place))
        };
        let [of_fine, of_coarse] = &self.positions;
        let fine = self.local.forward(pass, placed(fine, of_fine), time);
        let coarse = self.global.forward(pass, placed(coarse, of_coarse), time);
        let coarse = images_of(coarse);
        let far = volume::doubled_in_space(pass, coarse, time, self.upwards.weight(pass));
        let far = tokens(relu(far));
        let (near, far) = (
            self.decoders[0].forward(pass, fine.clone(), far.clone(), n),
            self.decoders[1].forward(pass, far, fine, n),
        );

        let fine_in_time = |x: Tensor<4>, kernels: &[Kernel; 3]| {
            let (mut x, mut moments) = (images_of(x), time);
            for (k, kernel) in kernels.iter().enumerate() {
                x = volume::doubled_in_time(pass, x, moments, kernel.weight(pass));
                moments *= 2;
                if k < 2 {
                    x = relu(x);
                }
            }
            // The numbers of halved moments were rounded up.
            let c = x.dims()[1];
            x.reshape([n, moments, c * h * w])
                .narrow(1, 0, second)
                .reshape([n * second, c, h, w])
        };
        let [of_near, of_far] = &self.over_time;
        let (near, far) = (fine_in_time(near, of_near), fine_in_time(far, of_far));
        let x = Tensor::cat(vec![shallow, far, near], 1);
        let [join, last] = &self.joined;
        let x = volume::conv(pass, x, second, join.weight(pass), three(1));
        let x = ops::leaky_relu(join.biased(pass, x), SLOPE);
        let x = volume::conv(pass, x, second, last.weight(pass), three(1));
        let x = last.biased(pass, x);
        self.depth.forward(pass, by_channel(x, second), h)
    }

    /// Returns features of four scales, and the number of moments.
    fn scales(&self, pass: &Pass, x: Tensor<4>, time: usize) -> (Tensor<4>, usize) {
        let [straight, wide, of_wide, of_straight] = &self.scales;
        let of = |kernel: &Kernel, y| relu(kernel.biased(pass, y));
        let a = volume::conv(pass, x.clone(), time, straight.weight(pass), three(2));
        let b = volume::dilated(pass, x, time, wide.weight(pass), gaps(2));
        let (a, b, time) = (of(straight, a), of(wide, b), three(2).moments(time));
        let c = volume::conv(pass, b.clone(), time, of_wide.weight(pass), three(1));
        let d = volume::dilated(pass, a.clone(), time, of_straight.weight(pass), gaps(1));
        let (c, d) = (of(of_wide, c), of(of_straight, d));
        (Tensor::cat(vec![a, b, c, d], 1), time)
    }

    /// Halves the number of moments with the filter and the residual blocks.
    fn halved(&self, pass: &Pass, x: Tensor<4>, time: usize) -> (Tensor<4>, usize) {
        let filtered = volume::conv(pass, x.clone(), time, pass.get(self.filter), three(2));
        let y = volume::conv_bordered_halved(pass, x, time, self.halved.weight(pass));
        let bias = self.halved.bias.expect("declared with one");
        let mut y = ops::crop(y, pass.get(bias));
        let time = three(2).moments(time);
        for block in &self.blocks {
            y = block.forward(pass, y, time);
        }
        (filtered + y, time)
    }

    /// Reduces the number of moments to a quarter.
    fn embedded(&self, pass: &Pass, mut x: Tensor<4>, mut time: usize) -> (Tensor<4>, usize) {
        for kernel in &self.embedded {
            let y = volume::conv5(pass, x, time, kernel.weight(pass), FIVE);
            x = relu(kernel.biased(pass, y));
            time = FIVE.moments(time);
        }
        let weight = self.fused.weight(pass);
        let [outputs, inputs, ..] = weight.dims();
        let bias = self.fused.bias.expect("declared with one");
        let y = ops::conv1x1(
            pass.lower(x),
            pass.lower(weight.reshape([outputs, inputs, 1, 1])),
            pass.lower(pass.get(bias)),
        );
        (relu(pass.raise(y)), time)
    }
}

impl Network for Nlost {
    const OVER_TIME: bool = true;

    fn build(d: &mut Declarations, spec: &NetSpec) -> Self {
        Self::declare(d, spec)
    }

    fn multiple(_spec: &NetSpec) -> (usize, &'static str, String) {
        let what =
            format!("nlost halves the image, and windows have {WINDOW}×{WINDOW} pixels of that");
        (2 * WINDOW, "net.architecture", what)
    }

    fn check(spec: &NetSpec) -> Result<(), ModelError> {
        if spec.width.is_multiple_of(HEADS) {
            return Ok(());
        }
        let what = format!(
            "{} must be a multiple of {HEADS}: heads and scales share it",
            spec.width
        );
        Err(ModelError::invalid("net.width", what))
    }

    fn multiply_adds(spec: &NetSpec, side: usize) -> f64 {
        let (c, features) = (spec.width, spec.streams() + FIRST);
        let [_, second, third, fourth, fifth] = moments(spec.dense);
        let (pixels, coarse) = ((side / 2).pow(2), (side / 4).pow(2));
        let part = c / 4;
        let scales = 27 * 2 * (features * part + part * part) * second;
        let halved = 27 * 6 * c * c * third;
        let embedded = 125 * c * c * fourth + (125 + 1) * c * c * fifth;
        // Queries, keys, values and the output layers over the image and over time; scores and the
        // weighted sums of values.
        let attention = |tokens: usize| {
            let layers = (8 + 2 * BETWEEN) * c * c;
            (layers + 2 * (tokens + fifth) * c) * fifth
        };
        let near = 27 * c * c * fifth + attention(WINDOW.pow(2));
        let far = (125 + 27) * c * c * fifth + attention(coarse);
        let upwards = 27 * c * c * fifth;
        let sums = 2 * (3 * c * c + c * c / groups(c) + 2 * c);
        let decoders = 2 * (sums + 2 * BETWEEN * c * c) * fifth;
        let over_time = 27 * (c * c / 2 * 2 + c * c / 8 * 4 + c * c / 4 * 8) * fifth;
        let joined = 27 * (3 * c * c + c * features) * second;
        let of_pixel =
            scales + halved + embedded + near + upwards + decoders + 2 * over_time + joined;
        spec.of_downsample(side, FIRST)
            + (of_pixel * pixels + far * coarse) as f64
            + spec.of_rendering(side, features)
    }

    fn describe(spec: &NetSpec) -> String {
        format!("NLOST, width {}", spec.width)
    }

    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        Self::forward(self, pass, input)
    }
}

/// Converts images to the layout with channels last.
fn tokens(x: Tensor<4>) -> Tensor<4> {
    x.permute([0, 2, 3, 1])
}

/// Converts tokens to images.
fn images_of(x: Tensor<4>) -> Tensor<4> {
    x.permute([0, 3, 1, 2])
}
