//! SwinIR (Liang et al., ICCVW 2021): attention within windows, at a constant image size. The names
//! and order of its parameters are the released code's.
//!
//! The original network removes noise and adds its result to its input. Here input and output are
//! different quantities, so nothing is added. Stochastic depth is omitted.

use burn::tensor::Tensor;

use super::{
    layer::{Conv, Dense, LayerNorm, table},
    network::Network,
    pass::{Input, Pass},
    spec::{NetSpec, Swin},
};
use crate::{
    ModelError, ops,
    parameters::{Declarations, Id},
};

/// The ratio of the channels between the two layers of a block's perceptron to those of the
/// features.
const BETWEEN: usize = 2;

#[derive(Debug, Clone)]
pub(super) struct Swinir {
    first: Conv,
    /// The norm of the first features, in front of the groups.
    embedded: LayerNorm,
    groups: Vec<Group>,
    norm: LayerNorm,
    after: Conv,
    last: Conv,
    window: usize,
}

/// Blocks and a convolution. Their result is added to the input.
#[derive(Debug, Clone)]
struct Group {
    blocks: Vec<Block>,
    conv: Conv,
}

/// x + attention(norm(x)), then x + perceptron(norm(x)).
#[derive(Debug, Clone)]
struct Block {
    norms: [LayerNorm; 2],
    positions: Id,
    qkv: Dense,
    project: Dense,
    perceptron: [Dense; 2],
    /// Whether its windows are shifted by half a window.
    shifted: bool,
}

impl Swinir {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        let (width, swin) = (spec.width, &spec.swin);
        let conv =
            |d: &mut Declarations, at: &str, outputs| Conv::declare(d, at, [width, 0], outputs);
        let first = Conv::declare(d, "conv_first", [spec.dense, spec.one_hot], width);
        let embedded = LayerNorm::declare(d, "patch_embed.norm", width);
        let groups = (0..swin.groups).map(|g| {
            let at = format!("layers.{g}");
            let blocks = (0..swin.depth).map(|b| {
                let at = format!("{at}.residual_group.blocks.{b}");
                Block::declare(d, &at, width, swin, b % 2 == 1)
            });
            let blocks = blocks.collect();
            let conv = conv(d, &format!("{at}.conv"), width);
            Group { blocks, conv }
        });
        Self {
            first,
            embedded,
            groups: groups.collect(),
            norm: LayerNorm::declare(d, "norm", width),
            after: conv(d, "conv_after_body", width),
            last: Conv::beginning(d, "conv_last", [width, 0], spec.outputs, spec.added),
            window: swin.window as usize,
        }
    }

    pub(super) fn forward(&self, pass: &Pass, input: Input) -> Tensor<4> {
        let first = self.first.forward(pass, input.dense, input.one_hot);
        let [_, _, h, w] = first.dims();
        // An image of one window cannot be shifted (released code).
        let shift = match h.min(w) > self.window {
            true => self.window / 2,
            false => 0,
        };
        let windows = |shift| ops::Windows::new([h, w], self.window, shift, &first.device());
        let (straight, shifted) = (windows(0), windows(shift));
        let mut x = self.embedded.forward(pass, tokens_last(first.clone()));
        for group in &self.groups {
            let before = x.clone();
            for block in &group.blocks {
                let windows = if block.shifted { &shifted } else { &straight };
                x = block.forward(pass, x, windows);
            }
            let y = group.conv.forward(pass, channels_first(x), None);
            x = tokens_last(y) + before;
        }
        let x = channels_first(self.norm.forward(pass, x));
        let x = self.after.forward(pass, x, None) + first;
        self.last.forward(pass, x, None)
    }
}

impl Network for Swinir {
    const ADDS: bool = true;
    const OVER_TIME: bool = false;

    fn build(d: &mut Declarations, spec: &NetSpec) -> Self {
        Self::declare(d, spec)
    }

    fn multiple(spec: &NetSpec) -> (usize, &'static str, String) {
        let what = format!("windows have {0}×{0} pixels", spec.swin.window);
        (spec.swin.window as usize, "net.swin.window", what)
    }

    fn check(spec: &NetSpec) -> Result<(), ModelError> {
        let checked = spec.swin.check(spec.width);
        checked.map_err(|(field, what)| ModelError::invalid(format!("net.{field}"), what))
    }

    fn multiply_adds(spec: &NetSpec, side: usize) -> f64 {
        let (e, swin) = (spec.width, &spec.swin);
        let convolutions =
            spec.dense + spec.one_hot + e * (swin.groups as usize + 1) + spec.outputs;
        let tokens = (swin.window as usize).pow(2);
        // Queries, keys, values and the output layer; the perceptron; scores and the weighted sums
        // of values.
        let block = 4 * e * e + 2 * BETWEEN * e * e + 2 * tokens * e;
        let blocks = (swin.groups * swin.depth) as usize;
        ((9 * e * convolutions + blocks * block) * side * side) as f64
    }

    fn describe(spec: &NetSpec) -> String {
        let swin = &spec.swin;
        format!(
            "SwinIR, width {}, {} groups of {} blocks, {} heads, windows {4}×{4}",
            spec.width, swin.groups, swin.depth, swin.heads, swin.window
        )
    }

    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        Self::forward(self, pass, input)
    }
}

impl Block {
    fn declare(d: &mut Declarations, at: &str, width: usize, swin: &Swin, shifted: bool) -> Self {
        let places = (2 * swin.window as usize - 1).pow(2);
        let dense = |d: &mut Declarations, name: &str, inputs, outputs| {
            Dense::declare(d, &format!("{at}.{name}"), inputs, outputs)
        };
        let norm = |d: &mut Declarations, name: &str| {
            LayerNorm::declare(d, &format!("{at}.{name}"), width)
        };
        let first = norm(d, "norm1");
        let name = format!("{at}.attn.relative_position_bias_table");
        Self {
            positions: table(d, name, places, swin.heads as usize),
            qkv: dense(d, "attn.qkv", width, 3 * width),
            project: dense(d, "attn.proj", width, width),
            norms: [first, norm(d, "norm2")],
            perceptron: [
                dense(d, "mlp.fc1", width, BETWEEN * width),
                dense(d, "mlp.fc2", BETWEEN * width, width),
            ],
            shifted,
        }
    }

    /// Maps (N, H, W, C) to the same shape.
    fn forward(&self, pass: &Pass, x: Tensor<4>, windows: &ops::Windows) -> Tensor<4> {
        let seen = self.norms[0].forward(pass, x.clone());
        let qkv = self.qkv.forward(pass, seen);
        let bias = ops::position_bias(pass.get(self.positions), windows.window);
        let said = ops::window_attention(qkv, bias, windows);
        let x = x + self.project.forward(pass, said);
        let [first, second] = &self.perceptron;
        let between = ops::gelu(first.forward(pass, self.norms[1].forward(pass, x.clone())));
        x + second.forward(pass, between)
    }
}

/// Reorders (N, C, H, W) to (N, H, W, C).
fn tokens_last(x: Tensor<4>) -> Tensor<4> {
    x.permute([0, 2, 3, 1])
}

/// Reorders (N, H, W, C) to (N, C, H, W).
fn channels_first(x: Tensor<4>) -> Tensor<4> {
    x.permute([0, 3, 1, 2])
}
