//! The loss functions: L1 for depths, binary cross-entropy for masks.

use burn::tensor::{Tensor, TensorData};

use crate::{input::Target, ops};

/// A mean loss, or a sum of mean losses, which a device may still be computing.
#[derive(Debug, Clone)]
pub enum Loss {
    Known(f32),
    OnDevice(Box<Tensor<1>>),
}

impl Loss {
    /// Returns the value. Waits until the device has finished its earlier work.
    pub fn value(self) -> f32 {
        match self {
            Self::Known(loss) => loss,
            Self::OnDevice(loss) => loss.into_scalar::<f32>(),
        }
    }

    /// Returns whether the loss is known to be NaN or infinite. The value of a loss on a device is
    /// not known.
    pub fn is_broken(&self) -> bool {
        matches!(self, Self::Known(loss) if !loss.is_finite())
    }

    pub fn plus(self, other: Self) -> Self {
        match (self, other) {
            (Self::OnDevice(a), Self::OnDevice(b)) => Self::OnDevice(Box::new(*a + *b)),
            (a, b) => Self::Known(a.value() + b.value()),
        }
    }
}

/// Returns the mean loss of a batch, and the tensor from which to run the backward pass. Outputs
/// and truth are (N, C, H, W).
///
/// On the CPU both are computed here, in a fixed order and with `libm`, so that the bits do not
/// depend on the instruction set or the system's mathematics library. On other devices, the device
/// computes them.
pub fn loss(target: Target, output: Tensor<4>, truth: &[f32]) -> (Loss, Tensor<1>) {
    if !ops::has_kernels(&output.device()) {
        let truth = TensorData::new(truth.to_vec(), output.dims());
        let truth = Tensor::from_data(truth, &output.device());
        let loss = on_device(target, output, truth);
        return (Loss::OnDevice(Box::new(loss.clone().inner())), loss);
    }
    let said = output.clone().inner().into_data_as::<f32>();
    let said: Vec<f32> = said.try_into_vec().expect("asked for f32");
    let (loss, gradient) = by_hand(target, &said, truth);
    let gradient = TensorData::new(gradient, output.dims());
    let gradient = Tensor::<4>::from_data(gradient, &output.device());
    (Loss::Known(loss), (output * gradient).sum())
}

/// Computes loss and gradient value by value.
fn by_hand(target: Target, said: &[f32], truth: &[f32]) -> (f32, Vec<f32>) {
    let share = 1.0 / said.len() as f32;
    let mut sum = 0.0f64;
    let pairs = said.iter().zip(truth);
    let gradient = pairs
        .map(|(x, t)| match target {
            Target::Tof => {
                let off = x - t;
                sum += f64::from(off.abs());
                match off.partial_cmp(&0.0) {
                    Some(std::cmp::Ordering::Greater) => share,
                    Some(std::cmp::Ordering::Less) => -share,
                    Some(std::cmp::Ordering::Equal) => 0.0,
                    None => f32::NAN,
                }
            }
            Target::Shadow | Target::Specular => {
                let small = libm::expf(-x.abs());
                sum += f64::from(x.max(0.0) - x * t + libm::log1pf(small));
                // 1/(1 + exp(−x)), without overflow on either side.
                let sigmoid = if *x >= 0.0 { 1.0 } else { small } / (1.0 + small);
                (sigmoid - t) * share
            }
        })
        .collect();
    ((sum / said.len() as f64) as f32, gradient)
}

fn on_device(target: Target, x: Tensor<4>, t: Tensor<4>) -> Tensor<1> {
    match target {
        Target::Tof => (x - t).abs().mean(),
        // max(x, 0) − x·t + log(1 + exp(−|x|)), which no logit overflows.
        Target::Shadow | Target::Specular => {
            let rest = x.clone().abs().neg().exp().log1p();
            (x.clone().clamp_min(0.0) - x * t + rest).mean()
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    #[test]
    fn by_hand_is_what_the_device_says_and_no_logit_overflows() {
        let said = [-200.0, -3.0, -1e-4, 0.5, 0.25, 80.0];
        let truth = [1.0, 0.0, 1.0, 0.0, 1.0, 1.0];
        for target in [Target::Tof, Target::Shadow] {
            let (loss, gradient) = by_hand(target, &said, &truth);
            let device = Device::flex().autodiff();
            let tensor = |values: [f32; 6]| {
                Tensor::<4>::from_data(TensorData::new(values.to_vec(), [1, 1, 2, 3]), &device)
            };
            let x = tensor(said).require_grad();
            let theirs = on_device(target, x.clone(), tensor(truth));
            let by = x.grad(&theirs.backward()).unwrap().into_data_as::<f32>();
            let theirs = theirs.inner().into_scalar::<f32>();
            assert!(
                (loss - theirs).abs() < 1e-5 * theirs,
                "{target:?}: {loss} and {theirs}"
            );
            for (a, b) in gradient.iter().zip(by.iter::<f32>()) {
                assert!((a - b).abs() < 1e-6, "{target:?}: {a} and {b}");
            }
        }
    }
}
