//! Networks in bfloat16: the rounded values, their agreement with a device that supports the
//! format, and learning.

use crate::common;

use burn::tensor::{Device, Distribution, FloatDType, Int, Tensor, TensorData};
use common::{plan, sources};
use picofarm_model::{
    input::{ShadowVariant, Target},
    net::Precision,
    ops::{self, plain},
    train::{Control, Ended, Event, Plan, Trained, Training},
};

fn values<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data_as::<f32>().try_into_vec().unwrap()
}

#[test]
fn numbers_and_their_gradients_are_rounded_to_the_nearest_and_ties_to_even() {
    let device = Device::flex().autodiff();
    let one = 1.0f32;
    let step = 1.0 / 128.0;
    let given = [
        one,
        one + 0.5 * step,
        one + 0.51 * step,
        one + 1.5 * step,
        -3e38,
        1e-40,
    ];
    let x = Tensor::<1>::from_data(TensorData::from(given), &device).require_grad();
    let y = ops::to_bf16(x.clone());
    let expected = [one, one, one + step, one + 2.0 * step];
    let rounded = values(y.clone().inner());
    assert_eq!(rounded[..4], expected);
    for (rounded, given) in rounded.iter().zip(given) {
        assert_eq!(rounded.to_bits() & 0xffff, 0, "{given} became {rounded}");
    }
    // Gradients of a sum weighted by numbers that bfloat16 cannot represent.
    let weights = Tensor::<1>::from_data(TensorData::from([1.001f32; 6]), &device);
    let mut gradients = (y * weights).sum().backward();
    let gradient = values(x.grad_remove(&mut gradients).unwrap());
    assert_eq!(gradient, [1.0; 6]);
}

#[test]
fn convolutions_are_those_of_a_device_that_has_such_numbers() {
    let device = Device::flex();
    device.seed(4);
    let random =
        |shape: [usize; 4]| Tensor::<4>::random(shape, Distribution::Normal(0.0, 1.0), &device);
    let (x, w) = (random([2, 24, 9, 7]), random([12, 24, 3, 3]));
    let bins = Tensor::<3, Int>::random([2, 9, 7], Distribution::Uniform(-2.0, 14.0), &device);
    let one_hot = random([12, 12, 3, 3]);
    let ours = ops::conv3x3(ops::to_bf16(x.clone()), ops::to_bf16(w.clone()))
        + ops::one_hot_conv3x3(bins.clone(), ops::to_bf16(one_hot.clone()));
    let ours = values(ops::from_bf16(ours));
    let there = |t: Tensor<4>| t.cast(FloatDType::BF16);
    let theirs = plain::conv3x3(there(x), there(w)) + plain::one_hot_conv3x3(bins, there(one_hot));
    let theirs = values(theirs.cast(FloatDType::F32));
    let size = theirs.iter().fold(0f32, |a, b| a.max(b.abs()));
    // The tolerance is half a unit of the last place at each of two places.
    for (a, b) in ours.iter().zip(&theirs) {
        assert!((a - b).abs() <= size / 128.0, "{a} and {b}");
    }
}

fn in_bf16(target: Target, variant: ShadowVariant) -> Plan {
    let mut plan = plan(target, variant);
    plan.net.precision = Precision::Bf16;
    plan.epochs = 12;
    plan
}

fn trained(plan: &Plan, stop: Option<u64>) -> Trained {
    let device = Device::flex();
    let mut training = Training::start(plan.clone(), None, sources(), &device).unwrap();
    if let Some(stop) = stop {
        let ended = training.run(&mut |_, event| match event {
            Event::Step { step, .. } if *step >= stop => Control::Stop,
            _ => Control::Continue,
        });
        assert_eq!(ended.unwrap(), Ended::Stopped);
        let checkpoint = training.checkpoint();
        training =
            Training::resume(plan.clone(), &[checkpoint.as_slice()], sources(), &device).unwrap();
    }
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

#[test]
fn networks_learn_in_bf16_as_in_f32_and_go_on_to_the_same_bits() {
    for (target, variant, share) in [
        (Target::Tof, ShadowVariant::Concat, 0.8),
        (Target::Shadow, ShadowVariant::Concat, 1.0),
    ] {
        let rounded = in_bf16(target, variant);
        let mut exact = rounded.clone();
        exact.net.precision = Precision::F32;
        let (rounded_end, exact_end) = (trained(&rounded, None), trained(&exact, None));
        assert_ne!(rounded_end.weights, exact_end.weights);
        let [first, last] =
            [0, 11].map(|i| (rounded_end.history[i].loss, exact_end.history[i].loss));
        assert!((first.0 - first.1).abs() < 0.03 * first.1, "{first:?}");
        assert!(last.0 < share * first.0, "{first:?} {last:?}");
        assert!((last.0 - last.1).abs() < 0.25 * last.1, "{last:?}");
        let resumed = trained(&rounded, Some(7));
        assert_eq!(resumed.weights, rounded_end.weights);
        assert_eq!(resumed.history, rounded_end.history);
    }
}

#[test]
fn a_plan_in_f32_is_written_as_ever() {
    let text = |plan: &Plan| serde_json::to_string(plan).unwrap();
    let exact = text(&plan(Target::Tof, ShadowVariant::Concat));
    assert!(!exact.contains("precision"), "{exact}");
    let rounded = text(&in_bf16(Target::Tof, ShadowVariant::Concat));
    assert!(rounded.contains("\"precision\":\"bf16\""), "{rounded}");
}
