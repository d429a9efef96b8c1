//! A fitted scene: densities at positions, distances along rays, and the whole as a field on a
//! grid.

use burn::tensor::Device;
use picofarm_reconstruct::{
    Reconstructed,
    field::{EMPTY, Field, PEAK, SOLID},
    render::{Distances, Stopped},
};
use picofarm_scene::Vec3;

use crate::{
    network::{Network, host},
    render::{Rays, Sampling, matrix},
    sample::Draws,
    settings::Settings,
    training::{Training, shape},
};

/// The number of positions that are computed at once.
const PLACES: usize = 1 << 14;

/// The result of a camera ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// The mean distance Σ w z, metres: the paper's depth.
    pub depth_m: f32,
    /// The share of the stopped light, without the last sample, which is endless.
    pub opacity: f32,
}

/// Both networks, with fixed weights.
#[derive(Debug, Clone)]
pub struct Fitted {
    networks: [Network; 2],
    settings: Settings,
}

impl Training {
    /// Returns the networks with their current weights.
    pub fn fitted(&self) -> Fitted {
        let device = Device::flex();
        let of = |k: usize| Network::new(shape(&self.settings), &self.state.weights[k], &device);
        Fitted {
            networks: [of(0), of(1)],
            settings: self.settings,
        }
    }

    /// Returns the current result on the grid of `start`: its box, evidence, depth and
    /// measurements, with the densities of the fine network.
    pub fn finish(self, start: Reconstructed) -> Reconstructed {
        let field = self.fitted().sampled(&start.field);
        let mut notes = self.notes();
        notes.push(
            "mlp: density comes from the network everywhere, guessed where evidence is 0".into(),
        );
        Reconstructed {
            field,
            loss: self
                .state
                .loss
                .is_finite()
                .then(|| f64::from(self.state.loss)),
            iterations: self.state.step,
            planes: Vec::new(),
            notes,
            ..start
        }
    }
}

impl Fitted {
    /// Changes the number of stratified samples a ray: the paper evaluates with 1,024.
    #[must_use]
    pub fn with_coarse(self, coarse: usize) -> Self {
        let settings = Settings {
            coarse,
            ..self.settings
        };
        Self { settings, ..self }
    }

    /// Returns the densities of the fine network, 1/m.
    pub fn densities(&self, places: &[Vec3]) -> Vec<f32> {
        let mut out = Vec::with_capacity(places.len());
        for some in places.chunks(PLACES) {
            let places = matrix(&flat(some), [some.len(), 3], &Device::flex());
            out.extend(host(self.networks[1].density(places)));
        }
        out
    }

    /// Returns the densities at the nodes of a grid, limited to the range that it can represent: up
    /// to 4/h.
    pub fn sampled(&self, grid: &Field) -> Field {
        let mut field = grid.clone();
        let logit = |density: f32| {
            let share = density * field.spacing / PEAK;
            let u = libm::logf(share / (1.0 - share).max(0.0));
            // An empty node has −∞; max and min drop the NaN of a density that exceeds the range.
            if share >= 1.0 {
                SOLID
            } else {
                u.clamp(EMPTY, SOLID)
            }
        };
        let mut logits = Vec::with_capacity(grid.logit.len());
        for from in (0..grid.logit.len()).step_by(PLACES) {
            let to = (from + PLACES).min(grid.logit.len());
            let places: Vec<Vec3> = (from..to).map(|i| grid.at(i)).collect();
            logits.extend(self.densities(&places).into_iter().map(logit));
        }
        field.logit = logits;
        field
    }

    /// Renders rays from one position along unit directions, with even samples.
    pub fn view(&self, origin: Vec3, directions: &[Vec3]) -> Vec<Ray> {
        let s = &self.settings;
        let sampling = Sampling {
            near: s.near_m,
            coarse: s.coarse,
            fine: s.fine,
        };
        let device = Device::flex();
        let mut out = Vec::with_capacity(directions.len());
        for some in directions.chunks((PLACES / (s.coarse + s.fine)).max(1)) {
            let n = some.len();
            let rays = Rays {
                origin: matrix(&flat(&vec![origin; n]), [n, 3], &device),
                direction: matrix(&flat(some), [n, 3], &device),
                far: matrix(&vec![s.far_m; n], [n, 1], &device),
            };
            let [_, fine] = sampling.render(&self.networks, &rays, &Draws::default());
            let last = s.coarse + s.fine - 1;
            let stopped = fine.weights.slice([0..n, 0..last]).sum_dim(1);
            let each = host(fine.depth).into_iter().zip(host(stopped));
            out.extend(each.map(|(depth_m, opacity)| Ray { depth_m, opacity }));
        }
        out
    }
}

impl Distances for Fitted {
    fn distances(&self, origin: Vec3, directions: &[Vec3]) -> Vec<Stopped> {
        let rays = self.view(origin, directions).into_iter();
        rays.map(|ray| Stopped {
            or_end_m: ray.depth_m,
            met: ray.opacity > 0.5,
        })
        .collect()
    }
}

fn flat(vectors: &[Vec3]) -> Vec<f32> {
    vectors.iter().flat_map(|v| [v.x, v.y, v.z]).collect()
}
