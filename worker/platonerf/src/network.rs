//! The network of one density field: encoded position → eight layers → density (NeRF, Mildenhall et
//! al. 2020; PlatoNeRF retains only the density). The weights are a flat array, layer by layer,
//! with each layer's matrix (outputs, inputs) before its bias: PyTorch's shapes.

use burn::tensor::{Device, Gradients, Tensor, TensorData, activation::relu};

use crate::random::{Purpose, Random};

/// The number of frequencies of the encoding, in 1/m: 1, 2, 4, … 512.
pub const FREQUENCIES: usize = 10;
/// The number of values that encode a position.
pub const ENCODED: usize = 3 + 6 * FREQUENCIES;

/// Sizes of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// The number of values between layers.
    pub width: usize,
    /// The number of layers before the density.
    pub layers: usize,
}

impl Shape {
    /// Returns the layer after which the encoded position is joined: 4 of 0..8.
    fn joined(self) -> usize {
        self.layers / 2
    }

    /// Returns the numbers of outputs and inputs of each layer; the density is the last.
    pub fn sizes(self) -> Vec<[usize; 2]> {
        let inputs = |layer: usize| match layer {
            0 => ENCODED,
            _ if layer == self.joined() + 1 => ENCODED + self.width,
            _ => self.width,
        };
        let outputs = |layer| if layer < self.layers { self.width } else { 1 };
        (0..=self.layers)
            .map(|layer| [outputs(layer), inputs(layer)])
            .collect()
    }

    /// Returns the number of weights.
    pub fn weights(self) -> usize {
        self.sizes().iter().map(|[o, i]| o * i + o).sum()
    }

    /// Returns the initial weights: uniform in ±1/√inputs, PyTorch's default for linear layers.
    /// `which` distinguishes the networks, and `draw` the attempts for one network.
    pub fn begin(self, seed: u64, draw: u32, which: usize) -> Vec<f32> {
        let mut random = Random::new(seed, Purpose::Weights, u64::from(draw), which as u64);
        let mut out = Vec::with_capacity(self.weights());
        for [outputs, inputs] in self.sizes() {
            let bound = 1.0 / (inputs as f32).sqrt();
            let count = outputs * inputs + outputs;
            out.extend((0..count).map(|_| (2.0 * random.unit() - 1.0) * bound));
        }
        out
    }
}

/// A network on a device.
#[derive(Debug, Clone)]
pub struct Network {
    joined: usize,
    layers: Vec<(Tensor<2>, Tensor<1>)>,
}

impl Network {
    /// Creates a network from [`Shape::weights`] flat weights. On an autodiff device, the weights
    /// have gradients.
    pub fn new(shape: Shape, flat: &[f32], device: &Device) -> Self {
        let mut rest = flat;
        let mut take = |count: usize| {
            let (head, tail) = rest.split_at(count);
            rest = tail;
            head.to_vec()
        };
        let mut layer = |[outputs, inputs]: [usize; 2]| {
            let matrix = TensorData::new(take(outputs * inputs), [outputs, inputs]);
            let bias = TensorData::new(take(outputs), [outputs]);
            let matrix = Tensor::<2>::from_data(matrix, device);
            let bias = Tensor::<1>::from_data(bias, device);
            match matrix.is_autodiff() {
                true => (matrix.require_grad(), bias.require_grad()),
                false => (matrix, bias),
            }
        };
        Self {
            joined: shape.joined(),
            layers: shape.sizes().into_iter().map(&mut layer).collect(),
        }
    }

    /// Returns the densities in 1/m at positions in metres: (P, 3) to (P).
    pub fn density(&self, places: Tensor<2>) -> Tensor<1> {
        let encoded = encode(places);
        let mut x = encoded.clone();
        let last = self.layers.len() - 1;
        for (k, (matrix, bias)) in self.layers.iter().enumerate() {
            let y = x.matmul(matrix.clone().transpose()) + bias.clone().unsqueeze::<2>();
            let y = relu(y);
            if k == last {
                return y.squeeze_dim::<1>(1);
            }
            x = match k == self.joined {
                true => Tensor::cat(vec![encoded.clone(), y], 1),
                false => y,
            };
        }
        unreachable!("the last layer returns")
    }

    /// Returns the gradient of the flat weights; 0 if the loss does not depend on them.
    pub fn gradient(&self, of: &mut Gradients) -> Vec<f32> {
        let mut out = Vec::new();
        for (matrix, bias) in &self.layers {
            let [a, b] = matrix.dims();
            match matrix.grad_remove(of) {
                Some(g) => out.extend(host(g)),
                None => out.resize(out.len() + a * b, 0.0),
            }
            match bias.grad_remove(of) {
                Some(g) => out.extend(host(g)),
                None => out.resize(out.len() + a, 0.0),
            }
        }
        out
    }
}

/// Encodes positions as x, then sin(f·x) and cos(f·x) for each frequency: (P, 3) to (P, 63). There
/// is no scaling to a unit box and no factor π.
fn encode(places: Tensor<2>) -> Tensor<2> {
    let device = places.device();
    let [points, _] = places.dims();
    let frequencies: Vec<f32> = (0..FREQUENCIES).map(|k| (1u32 << k) as f32).collect();
    let frequencies =
        Tensor::<3>::from_data(TensorData::new(frequencies, [1, FREQUENCIES, 1]), &device);
    let angles = places.clone().reshape([points, 1, 3]) * frequencies;
    let waves = Tensor::cat(vec![angles.clone().sin(), angles.cos()], 2);
    Tensor::cat(vec![places, waves.reshape([points, 6 * FREQUENCIES])], 1)
}

/// Returns the values of a tensor, row by row.
pub(crate) fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    let data = tensor.into_data_as::<f32>();
    data.try_into_vec().expect("asked for f32")
}
