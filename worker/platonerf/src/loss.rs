//! PlatoNeRF's two losses. Means are over a whole batch. Parts of it are computed one after the
//! other, so each ray is weighted with its share of the mean.

use burn::tensor::{Device, Tensor};

use picofarm_settings::ShadowLoss;

use crate::{
    network::Network,
    rays::Batch,
    render::{Rays, Rendered, Sampling, length, matrix},
    sample::Draws,
    settings::Settings,
};

/// The factor of both losses.
const FACTOR: f32 = 100.0;
/// The distance of transmittances from 0 and 1 in the cross-entropy.
const MARGIN: f32 = 1e-3;

/// The stage of the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Distances of lit rays.
    Distance,
    /// Distances and shadows of all rays.
    Shadow,
}

/// The number of rays of a batch by class.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Counts {
    /// The number of lit rays.
    pub lit: usize,
    /// The number of shadowed rays.
    pub shadow: usize,
}

impl Counts {
    /// Counts the rays of a whole batch.
    pub fn of(batch: &Batch) -> Self {
        let lit = batch.lit_rays();
        Self {
            lit,
            shadow: batch.rays() - lit,
        }
    }
}

/// Random numbers for each rendering of rays: camera rays, light paths from the fine depth, and
/// light paths from the coarse depth.
pub type AllDraws = [Draws; 3];

/// Returns the contribution of a part of a batch to the batch's loss: a tensor of one number.
pub fn loss(
    settings: &Settings,
    stage: Stage,
    networks: &[Network; 2],
    part: &Batch,
    counts: Counts,
    draws: &AllDraws,
    device: &Device,
) -> Tensor<1> {
    let n = part.rays();
    let sampling = Sampling {
        near: settings.near_m,
        coarse: settings.coarse,
        fine: settings.fine,
    };
    let origin: Vec<f32> = part.origin.iter().copied().cycle().take(3 * n).collect();
    let origin = matrix(&origin, [n, 3], device);
    let direction = matrix(&part.direction, [n, 3], device);
    let spot = matrix(&part.spot, [n, 3], device);
    let camera = Rays {
        origin: origin.clone(),
        direction: direction.clone(),
        far: matrix(&vec![settings.far_m; n], [n, 1], device),
    };
    // An empty class has no mean and contributes nothing.
    let share = |of: f32, count: usize| move |l: &f32| f32::from(*l == of) / count.max(1) as f32;
    let column = |f: &dyn Fn(&f32) -> f32| {
        let values: Vec<f32> = part.lit.iter().map(f).collect();
        matrix(&values, [n, 1], device)
    };
    let of_lit = column(&share(1.0, counts.lit));
    let of_shadow = column(&share(0.0, counts.shadow));
    let path = matrix(&part.path_m, [n, 1], device);
    let tau = matrix(&part.tau_m, [n, 1], device);
    let [coarse, fine] = sampling.render(networks, &camera, &draws[0]);
    let mut sum = Tensor::<2>::zeros([1, 1], device);
    for (rendered, draws) in [(fine, &draws[1]), (coarse, &draws[2])] {
        let depth: Tensor<2> = rendered.depth.reshape([n, 1]);
        let point = origin.clone() + direction.clone() * depth.clone();
        let predicted = depth + length(spot.clone() - point.clone()) + path.clone();
        let error = (predicted - tau.clone()).div_scalar(settings.scale_m);
        let distance = (error.clone() * error * of_lit.clone()).sum_dim(0);
        if stage == Stage::Distance {
            sum = sum + distance;
            continue;
        }
        let light = Rays::between(point, spot.clone(), settings.near_m);
        let both = sampling.render(networks, &light, draws);
        sum = sum + distance.mul_scalar(settings.distance_weight);
        for rendered in both {
            let (lit, shadow) = (of_lit.clone(), of_shadow.clone());
            sum = sum + shadows(settings.shadow_loss, rendered, lit, shadow);
        }
    }
    sum.mul_scalar(FACTOR).reshape([1])
}

/// Compares transmittances with the mask.
fn shadows(
    how: ShadowLoss,
    rendered: Rendered,
    of_lit: Tensor<2>,
    of_shadow: Tensor<2>,
) -> Tensor<2> {
    let through: Tensor<2> = rendered.transmittance.unsqueeze_dim(1);
    let stopped = through.clone().neg().add_scalar(1.0);
    let each = match how {
        ShadowLoss::Squares => {
            stopped.clone() * stopped * of_lit + through.clone() * through * of_shadow
        }
        ShadowLoss::CrossEntropy => {
            let log = |t: Tensor<2>| t.mul_scalar(1.0 - 2.0 * MARGIN).add_scalar(MARGIN).log();
            (log(through) * of_lit + log(stopped) * of_shadow).neg()
        }
    };
    each.sum_dim(0)
}
