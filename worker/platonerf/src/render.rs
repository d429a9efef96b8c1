//! Volume rendering of rays through one network or two (NeRF, equations 3 and 5), with PlatoNeRF's
//! outputs: depth D = Σ wᵢ zᵢ, not divided by Σ wᵢ, and transmittance before the last two samples,
//! so that the wall at a spot stops nothing.

use burn::tensor::{Device, Tensor, TensorData};

use crate::{
    network::{Network, host},
    sample::{Draws, Places},
};

/// The length of the last sample, metres.
const ENDLESS_M: f32 = 1e10;
/// A constant added to the transmittance of each sample.
const LEAK: f32 = 1e-10;
/// The least length of the sampled part of a light path, metres. The paper has no bound, and
/// reverses the samples if a surface point is closer to the spot than `near`.
const SHORTEST_M: f32 = 1e-3;

/// The result of R rays.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// Σ w z, metres: (R).
    pub depth: Tensor<1>,
    /// The share of light before the last two samples: (R).
    pub transmittance: Tensor<1>,
    /// The weights w: (R, samples).
    pub weights: Tensor<2>,
}

/// Returns depth, transmittance and weights for densities (R, S) at distances (R, S).
pub fn volume(density: Tensor<2>, z: Tensor<2>) -> Rendered {
    let [rays, samples] = z.dims();
    let device = z.device();
    let next = z.clone().slice([0..rays, 1..samples]);
    let this = z.clone().slice([0..rays, 0..samples - 1]);
    let last = Tensor::<2>::full([rays, 1], ENDLESS_M, &device);
    let length = Tensor::cat(vec![next - this, last], 1);
    let opacity = (density * length).neg().exp().neg().add_scalar(1.0);
    let passed = opacity.clone().neg().add_scalar(1.0).add_scalar(LEAK);
    // The product of the previous samples' transmittances, as exp Σ log: its gradient needs no
    // division.
    let logs = passed.log().slice([0..rays, 0..samples - 1]);
    let zero = Tensor::<2>::zeros([rays, 1], &device);
    let light = Tensor::cat(vec![zero, logs.cumsum(1)], 1).exp();
    let weights = opacity * light.clone();
    Rendered {
        depth: (weights.clone() * z).sum_dim(1).squeeze_dim::<1>(1),
        transmittance: light
            .slice([0..rays, samples - 2..samples - 1])
            .squeeze_dim::<1>(1),
        weights,
    }
}

/// R rays on a device: origins (R, 3), unit directions (R, 3), ends (R, 1), metres.
#[derive(Debug, Clone)]
pub struct Rays {
    /// The starts of the rays.
    pub origin: Tensor<2>,
    /// The directions of the rays.
    pub direction: Tensor<2>,
    /// The ends of the rays.
    pub far: Tensor<2>,
}

impl Rays {
    /// Returns rays from points to other points.
    pub fn between(from: Tensor<2>, to: Tensor<2>, near: f32) -> Self {
        let way = to - from.clone();
        let length = length(way.clone());
        Self {
            origin: from,
            direction: way / length.clone(),
            far: length.clamp_min(near + SHORTEST_M),
        }
    }
}

/// Returns the lengths of the rows: (R, 3) to (R, 1). They are bounded below, because a root has no
/// slope at 0.
pub(crate) fn length(rows: Tensor<2>) -> Tensor<2> {
    (rows.clone() * rows).sum_dim(1).clamp_min(1e-12).sqrt()
}

/// The sampling of rays.
#[derive(Debug, Clone, Copy)]
pub struct Sampling {
    /// The start of samples, metres.
    pub near: f32,
    /// The number of stratified samples.
    pub coarse: usize,
    /// The number of samples by importance.
    pub fine: usize,
}

impl Sampling {
    /// Renders rays with the coarse network, then with the fine one where the coarse one has
    /// matter: \[coarse, fine\].
    pub fn render(self, networks: &[Network; 2], rays: &Rays, draws: &Draws) -> [Rendered; 2] {
        let far = host(rays.far.clone());
        let first = Places::stratified(far.len(), self.coarse, self.near, &draws.jitter);
        let coarse = look(&networks[0], rays, &first);
        let weights = host(coarse.weights.clone());
        let second = first.refined(&far, &weights, self.fine, &draws.share);
        let fine = look(&networks[1], rays, &second);
        [coarse, fine]
    }
}

/// Renders rays with one network at given positions.
fn look(network: &Network, rays: &Rays, places: &Places) -> Rendered {
    let device = rays.origin.device();
    let (n, samples) = (places.rays, places.count);
    let base = matrix(&places.base, [n, samples], &device);
    let slope = matrix(&places.slope, [n, samples], &device);
    let z = base + rays.far.clone() * slope;
    let along = rays.direction.clone().reshape([n, 1, 3]) * z.clone().reshape([n, samples, 1]);
    let points = rays.origin.clone().reshape([n, 1, 3]) + along;
    let density = network.density(points.reshape([n * samples, 3]));
    volume(density.reshape([n, samples]), z)
}

/// Converts host values to a matrix.
pub(crate) fn matrix(values: &[f32], shape: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), device)
}
