//! Adam (Kingma and Ba 2015) with PyTorch's order of operations. The flat weights are on the host,
//! because they are few compared with the points at which they are used.

use picofarm_reconstruct::saved::Moments;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f32 = 1e-8;

/// Takes one step of the weights; `step` counts from 1.
pub fn step(moments: &mut Moments, weights: &mut [f32], gradient: &[f32], rate: f64, step: u32) {
    let power = |base: f64| 1.0 - libm::pow(base, f64::from(step));
    let rate = (rate / power(BETA1)) as f32;
    let root = power(BETA2).sqrt() as f32;
    let (lean, square) = ((1.0 - BETA1) as f32, (1.0 - BETA2) as f32);
    let moments = moments.first.iter_mut().zip(&mut moments.second);
    for ((w, g), (m, v)) in weights.iter_mut().zip(gradient).zip(moments) {
        *m += (g - *m) * lean;
        *v = *v * BETA2 as f32 + g * g * square;
        *w -= rate * *m / (v.sqrt() / root + EPSILON);
    }
}
