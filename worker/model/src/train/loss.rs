//! What is minimised: L1 for depths, binary cross-entropy for masks.

use burn::tensor::Tensor;

use crate::input::Task;

/// Mean loss of a batch: outputs and truth (N, C, H, W).
pub fn loss(task: Task, output: Tensor<4>, truth: Tensor<4>) -> Tensor<1> {
    match task {
        Task::Tof => (output - truth).abs().mean(),
        Task::Shadow | Task::Specular => cross_entropy(output, truth),
    }
}

/// Binary cross-entropy from logits x: max(x, 0) − x·t + log(1 + exp(−|x|)), which no logit overflows.
fn cross_entropy(x: Tensor<4>, t: Tensor<4>) -> Tensor<1> {
    let rest = x.clone().abs().neg().exp().log1p();
    (x.clone().clamp_min(0.0) - x * t + rest).mean()
}
