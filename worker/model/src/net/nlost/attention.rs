//! The attention of NLOST over images and over time, and between its two scales.

use burn::tensor::Tensor;

use super::{BETWEEN, HEADS, WINDOW, groups};
use crate::{
    net::{
        layer::{Dense, LayerNorm, table},
        pass::Pass,
    },
    ops,
    parameters::{Begin, Declarations, Id},
};

/// Converts (N·T, H, W, C) to a row of moments for each pixel: (N·H·W, T, C).
fn by_pixel(x: Tensor<4>, time: usize) -> Tensor<3> {
    let [images, h, w, c] = x.dims();
    let n = images / time;
    x.reshape([n, time, h * w, c])
        .swap_dims(1, 2)
        .reshape([n * h * w, time, c])
}

/// The inverse of [`by_pixel`] for images of (H, W).
fn by_moment(x: Tensor<3>, [h, w]: [usize; 2]) -> Tensor<4> {
    let [rows, time, c] = x.dims();
    let n = rows / (h * w);
    x.reshape([n, h * w, time, c])
        .swap_dims(1, 2)
        .reshape([n * time, h, w, c])
}

/// Two linear layers with GELU between them.
#[derive(Debug, Clone)]
struct Perceptron([Dense; 2]);

impl Perceptron {
    fn declare(d: &mut Declarations, at: &str, c: usize) -> Self {
        Self([
            Dense::usual(d, &format!("{at}.fc1"), c, BETWEEN * c),
            Dense::usual(d, &format!("{at}.fc2"), BETWEEN * c, c),
        ])
    }

    fn forward(&self, pass: &Pass, x: Tensor<4>) -> Tensor<4> {
        let [first, last] = &self.0;
        last.forward(pass, ops::gelu(first.forward(pass, x)))
    }
}

/// x + attention over time(attention over the image(norm(x))), then x + perceptron(norm(x)).
#[derive(Debug, Clone)]
pub(super) struct Encoder {
    norms: [LayerNorm; 2],
    /// The position biases of pixels and of moments; `None` in the global encoder.
    positions: Option<[Id; 2]>,
    qkv: [Dense; 2],
    project: [Dense; 2],
    perceptron: Perceptron,
}

impl Encoder {
    /// Declares an encoder. If `moments` is set, it has windows and position biases for that number
    /// of moments; otherwise it attends over all pixels and has neither.
    pub(super) fn declare(
        d: &mut Declarations,
        at: &str,
        c: usize,
        moments: Option<usize>,
    ) -> Self {
        let parts = ["attn_hw", "attn_t"];
        let positions = moments.map(|moments| {
            let rows = [(2 * WINDOW - 1).pow(2), 2 * moments - 1];
            [0, 1].map(|k| {
                let name = format!("{at}.{}.relative_position_bias_table", parts[k]);
                table(d, name, rows[k], HEADS)
            })
        });
        Self {
            positions,
            qkv: parts.map(|part| {
                let at = format!("{at}.{part}.qkv");
                match moments {
                    Some(_) => Dense::usual(d, &at, c, 3 * c),
                    None => Dense::without_bias(d, &at, c, 3 * c, Begin::FanIn(c)),
                }
            }),
            project: parts.map(|part| Dense::usual(d, &format!("{at}.{part}.proj"), c, c)),
            norms: ["norm1", "norm2"].map(|norm| LayerNorm::declare(d, &format!("{at}.{norm}"), c)),
            perceptron: Perceptron::declare(d, &format!("{at}.mlp"), c),
        }
    }

    /// Maps (N·T, H, W, C) to the same shape.
    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>, time: usize) -> Tensor<4> {
        let [images, h, w, c] = x.dims();
        let device = x.device();
        let seen = self.norms[0].forward(pass, x.clone());
        let qkv = self.qkv[0].forward(pass, seen);
        let said = match self.positions {
            Some([pixels, _]) => {
                let windows = ops::Windows::new([h, w], WINDOW, 0, &device);
                let bias = ops::position_bias(pass.get(pixels), WINDOW);
                ops::window_attention(qkv, bias, &windows)
            }
            None => ops::attend(qkv.reshape([images, h * w, 3 * c]), HEADS, None, None)
                .reshape([images, h, w, c]),
        };
        let said = self.project[0].forward(pass, said);

        let qkv = self.qkv[1].forward(pass, by_pixel(said, time));
        let bias = self
            .positions
            .map(|[_, moments]| differences(pass.get(moments), time));
        let said = self.project[1].forward(pass, ops::attend(qkv, HEADS, bias, None));
        let x = x + by_moment(said, [h, w]);
        let seen = self.norms[1].forward(pass, x.clone());
        x + self.perceptron.forward(pass, seen)
    }
}

/// Returns the rows of a table (2T − 1, heads) for each pair of moments, selected by the second's
/// distance from the first: (heads, T, T).
fn differences(table: Tensor<2>, time: usize) -> Tensor<3> {
    let table = table.transpose();
    let rows = (0..time).map(|at| table.clone().narrow(1, time - 1 - at, time));
    Tensor::stack(rows.collect(), 1)
}

/// x + sums over time(sums over the image(norms)), then x + perceptron(norm(x)).
#[derive(Debug, Clone)]
pub(super) struct Decoder {
    /// The norms of the decoder's input and of the queries.
    norms: [LayerNorm; 2],
    over_image: Sums,
    over_time: Sums,
    last: LayerNorm,
    perceptron: Perceptron,
}

impl Decoder {
    pub(super) fn declare(d: &mut Declarations, at: &str, c: usize) -> Self {
        let name = |name: &str| format!("{at}.{name}");
        Self {
            norms: ["norm1", "norm12"].map(|at| LayerNorm::declare(d, &name(at), c)),
            over_image: Sums::declare(d, &name("attn_hw.attn"), c, 1.0),
            over_time: Sums::declare(d, &name("attn_t.attn"), c, 0.0),
            last: LayerNorm::declare(d, &name("norm2"), c),
            perceptron: Perceptron::declare(d, &name("mlp"), c),
        }
    }

    /// Applies the decoder. Both tensors are (N·T, H, W, C).
    pub(super) fn forward(
        &self,
        pass: &Pass,
        x: Tensor<4>,
        asks: Tensor<4>,
        n: usize,
    ) -> Tensor<4> {
        let [images, h, w, c] = x.dims();
        let time = images / n;
        let own = self.norms[0].forward(pass, x.clone());
        let asks = self.norms[1].forward(pass, asks);
        let rows = |x: Tensor<4>| x.reshape([images, h * w, c]);
        let own = rows(own);
        let said = self
            .over_image
            .forward(pass, rows(asks.clone()), own.clone(), own);
        let said = by_pixel(said.reshape([images, h, w, c]), time);
        let said = self
            .over_time
            .forward(pass, by_pixel(asks, time), said.clone(), said);
        let x = x + by_moment(said, [h, w]);
        let seen = self.last.forward(pass, x.clone());
        x + self.perceptron.forward(pass, seen)
    }
}

/// Compact generalised non-local attention (Yue et al., "Compact generalized non-local network",
/// NeurIPS 2018) in groups of channels: θ·⟨φ, g⟩ with the product over all places and channels of a
/// group, followed by a layer and group norm.
#[derive(Debug, Clone, Copy)]
struct Sums {
    /// The projections θ, φ, g.
    projections: [Id; 3],
    /// One layer for each group.
    out: Id,
    scale: Id,
    shift: Id,
}

impl Sums {
    fn declare(d: &mut Declarations, at: &str, c: usize, scale: f32) -> Self {
        let groups = groups(c);
        let he = |fan_in: usize| Begin::Normal((2.0 / fan_in as f32).sqrt());
        let projections = ["t", "p", "g"]
            .map(|name| d.add(format!("{at}.{name}.weight"), &[c, c, 1], he(c), true));
        let part = c / groups;
        Self {
            projections,
            out: d.add(format!("{at}.z.weight"), &[c, part, 1], he(part), true),
            scale: d.add(
                format!("{at}.gn.weight"),
                &[c],
                Begin::Constant(scale),
                true,
            ),
            shift: d.add(format!("{at}.gn.bias"), &[c], Begin::Constant(0.0), true),
        }
    }

    /// Applies the attention to rows of places (R, P, C), the queries, with keys and values. The
    /// result has the same shape.
    fn forward(
        &self,
        pass: &Pass,
        asks: Tensor<3>,
        keys: Tensor<3>,
        values: Tensor<3>,
    ) -> Tensor<3> {
        let ([rows, places, c], device) = (values.dims(), values.device());
        let groups = groups(c);
        let part = c / groups;
        // (G, R, P·C/G)
        let grouped = |id: Id, x: Tensor<3>| {
            let weight: Tensor<3> = pass.get(id);
            let y = ops::linear(
                pass.lower(x),
                pass.lower(weight.reshape([c, c])),
                pass.lower(Tensor::zeros([c], &device)),
            );
            pass.raise(y)
                .reshape([rows, places, groups, part])
                .permute([2, 0, 1, 3])
                .reshape([groups, rows, places * part])
        };
        let [of_values, of_asks, of_keys] = &self.projections;
        let theta = grouped(*of_values, values);
        let phi = grouped(*of_asks, asks);
        let g = grouped(*of_keys, keys);
        let product = (phi * g).sum_dim(2).mul_scalar((part as f64).powf(-0.5));
        let x = (theta * product).reshape([groups, rows * places, part]);
        let out: Tensor<3> = pass.get(self.out);
        let out = out.reshape([groups, part, part]).swap_dims(1, 2);
        let x = pass.raise(pass.lower(x).matmul(pass.lower(out)));
        // Group norm.
        let x = x.reshape([groups, rows, places * part]);
        let x = x.clone() - x.mean_dim(2);
        let variance = x.clone().square().mean_dim(2);
        let x = x / (variance + ops::EPSILON).sqrt();
        let x = x
            .reshape([groups, rows, places, part])
            .permute([1, 2, 0, 3])
            .reshape([rows, places, c]);
        let one = |id| -> Tensor<3> { pass.get::<1>(id).reshape([1, 1, c]) };
        x * one(self.scale) + one(self.shift)
    }
}
