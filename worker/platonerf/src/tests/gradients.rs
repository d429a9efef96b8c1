//! Gradients compared with differences of the loss.

use burn::tensor::Device;

use super::{alive, room, small};
use crate::{
    Settings, ShadowLoss,
    loss::{Counts, Stage, loss},
    network::{Network, host},
    rays::Pool,
    training::{draws, shape},
};

/// Returns the relative error of the loss's slope along the gradient of one network's weights,
/// compared with central differences.
///
/// The gradient treats samples by importance as fixed, but they move with the weights. The test
/// therefore uses one such sample a ray, at the lower end of its distribution next to the ray's
/// origin, where it hardly moves.
fn error(settings: &Settings, stage: Stage, which: usize) -> f64 {
    let (pool, _) = Pool::new(room()).unwrap();
    let batch = pool.batch(stage == Stage::Distance, 1, 0, settings.batch);
    let mut draws = draws(settings, 0, 0, settings.batch);
    draws.iter_mut().for_each(|d| d.share.fill(0.0));
    let of = |weights: &[Vec<f32>; 2], device: &Device| {
        let networks = [0, 1].map(|k| Network::new(shape(settings), &weights[k], device));
        let counts = Counts::of(&batch);
        let root = loss(settings, stage, &networks, &batch, counts, &draws, device);
        (networks, root)
    };
    let weights = alive(settings).weights;
    let (networks, root) = of(&weights, &Device::flex().autodiff());
    let gradient = networks[which].gradient(&mut root.backward());
    let norm = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>();
    let moved = |step: f64| {
        let mut weights = weights.clone();
        let each = weights[which].iter_mut().zip(&gradient);
        each.for_each(|(w, g)| *w += (step * f64::from(*g)) as f32);
        f64::from(host(of(&weights, &Device::flex()).1)[0])
    };
    // Short steps drown in rounding. On long ones the loss is nonlinear, because light paths begin
    // at the depth and frequencies of 512/m turn within a millimetre. The test therefore takes the
    // best of some lengths.
    let slope = |length: f64| {
        let step = length / norm.sqrt();
        (moved(step) - moved(-step)) / (2.0 * step)
    };
    let errors = [3e-4, 1e-4, 3e-5, 1e-5, 3e-6].map(|length| (slope(length) / norm - 1.0).abs());
    errors.into_iter().fold(f64::INFINITY, f64::min)
}

#[test]
fn gradients_are_slopes_of_the_loss_in_both_stages() {
    let squares = ShadowLoss::Squares;
    for (stage, shadow_loss, distance_weight) in [
        (Stage::Distance, squares, 6000.0),
        (Stage::Shadow, squares, 6000.0),
        // Shadows alone: they affect the distance through the origin and the end of light paths.
        (Stage::Shadow, squares, 1e-9),
        (Stage::Shadow, ShadowLoss::CrossEntropy, 1e-9),
    ] {
        // The gradient of shadows alone for the fine network depends on its one sample by
        // importance; the comparison with PyTorch checks it.
        let networks: &[usize] = if distance_weight > 1.0 { &[0, 1] } else { &[0] };
        for &which in networks {
            let settings = Settings {
                shadow_loss,
                distance_weight,
                fine: 1,
                ..small()
            };
            let error = error(&settings, stage, which);
            println!("{stage:?} {shadow_loss:?} {distance_weight} network {which}: {error:.1e}");
            assert!(
                error < 0.02,
                "{stage:?} {shadow_loss:?} network {which}: {error}"
            );
        }
    }
}
