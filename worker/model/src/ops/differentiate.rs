//! The gradients of the operations, for burn's automatic differentiation.

use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{
    Autodiff, Flex, TensorMetadata,
    tensor::{FloatTensor, IntTensor},
};

use super::{cpu::NetOps, gradient};
use crate::kernel::{AdamW, AttentionShape};

type Cpu = FloatTensor<Flex>;
type Tracked = FloatTensor<Autodiff<Flex>>;

/// Registers a gradient for a parent that requires one.
macro_rules! give {
    ($grads:ident, $parent:expr, $value:expr) => {
        if let Some(node) = $parent {
            let value = $value;
            $grads.register::<Flex>(node.id, value);
        }
    };
}

#[derive(Debug)]
struct Conv3;
impl Backward<Flex, 2> for Conv3 {
    type State = (Cpu, Cpu);
    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let (x, w) = ops.state;
        let [to_x, to_w] = ops.parents;
        give!(grads, to_x, gradient::conv3x3_by_input(dy.clone(), w));
        give!(grads, to_w, gradient::conv3x3_by_weight(x, dy));
    }
}

#[derive(Debug)]
struct Conv1;
impl Backward<Flex, 3> for Conv1 {
    type State = (Cpu, Cpu);
    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let (x, w) = ops.state;
        let [to_x, to_w, to_bias] = ops.parents;
        give!(grads, to_x, gradient::conv1x1_by_input(dy.clone(), w));
        give!(grads, to_w, gradient::conv1x1_by_weight(x, dy.clone()));
        give!(grads, to_bias, gradient::conv1x1_by_bias(dy));
    }
}

#[derive(Debug)]
struct OneHot;
impl Backward<Flex, 1> for OneHot {
    type State = (IntTensor<Flex>, usize);
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let (bins, channels) = ops.state;
        let [to_w] = ops.parents;
        give!(
            grads,
            to_w,
            gradient::one_hot_conv3x3_by_weight(bins, dy, channels)
        );
    }
}

#[derive(Debug)]
struct Norm;
impl Backward<Flex, 3> for Norm {
    /// Input, scale, shift, mean, variance.
    type State = [Cpu; 5];
    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [x, gamma, beta, mean, variance] = ops.state;
        let (dx, dgamma, dbeta) =
            gradient::batch_norm_relu_grad(x, gamma, beta, mean, variance, dy);
        let [to_x, to_gamma, to_beta] = ops.parents;
        give!(grads, to_x, dx);
        give!(grads, to_gamma, dgamma);
        give!(grads, to_beta, dbeta);
    }
}

#[derive(Debug)]
struct Pool;
impl Backward<Flex, 1> for Pool {
    type State = Cpu;
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [to_x] = ops.parents;
        give!(grads, to_x, gradient::max_pool_grad(ops.state, dy));
    }
}

#[derive(Debug)]
struct Join;
impl Backward<Flex, 2> for Join {
    /// The number of channels of the first part.
    type State = usize;
    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let (dskip, dx) = gradient::join_upsampled_grad(dy, ops.state);
        let [to_skip, to_x] = ops.parents;
        give!(grads, to_skip, dskip);
        give!(grads, to_x, dx);
    }
}

#[derive(Debug)]
struct Attention;
impl Backward<Flex, 2> for Attention {
    type State = (Cpu, Cpu, AttentionShape);
    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let (qkv, bias, shape) = ops.state;
        let (dqkv, dbias) = gradient::window_attention_grad(qkv, bias, &shape, dy);
        let [to_qkv, to_bias] = ops.parents;
        give!(grads, to_qkv, dqkv);
        give!(grads, to_bias, dbias);
    }
}

#[derive(Debug)]
struct Gelu;
impl Backward<Flex, 1> for Gelu {
    type State = Cpu;
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [to_x] = ops.parents;
        give!(grads, to_x, gradient::gelu_grad(ops.state, dy));
    }
}

#[derive(Debug)]
struct Layer;
impl Backward<Flex, 3> for Layer {
    /// Input, scale, shift.
    type State = [Cpu; 3];
    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [x, gamma, beta] = ops.state;
        let (dx, dgamma, dbeta) = gradient::layer_norm_grad(x, gamma, beta, dy);
        let [to_x, to_gamma, to_beta] = ops.parents;
        give!(grads, to_x, dx);
        give!(grads, to_gamma, dgamma);
        give!(grads, to_beta, dbeta);
    }
}

#[derive(Debug)]
struct Surround;
impl Backward<Flex, 1> for Surround {
    /// The number of consecutive moments, and whether their channels are concatenated.
    type State = (usize, bool);
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let ((moments, volume), [to_x]) = (ops.state, ops.parents);
        give!(grads, to_x, gradient::surround_grad(dy, moments, volume));
    }
}

#[derive(Debug)]
struct Crop;
impl Backward<Flex, 2> for Crop {
    type State = ();
    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [to_x, to_bias] = ops.parents;
        give!(grads, to_x, gradient::crop_grad(dy.clone()));
        give!(grads, to_bias, gradient::conv1x1_by_bias(dy));
    }
}

#[derive(Debug)]
struct Leaky;
impl Backward<Flex, 1> for Leaky {
    type State = (Cpu, f32);
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let ((x, slope), [to_x]) = (ops.state, ops.parents);
        give!(grads, to_x, gradient::leaky_relu_grad(x, slope, dy));
    }
}

#[derive(Debug)]
struct Beside;
impl Backward<Flex, 1> for Beside {
    /// The number of moments of an image.
    type State = usize;
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [to_x] = ops.parents;
        give!(grads, to_x, gradient::adjacent_grad(dy, ops.state));
    }
}

#[derive(Debug)]
struct HalveTime;
impl Backward<Flex, 1> for HalveTime {
    type State = Cpu;
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [to_x] = ops.parents;
        give!(grads, to_x, gradient::halve_time_grad(ops.state, dy));
    }
}

impl<C: CheckpointStrategy> NetOps for Autodiff<Flex, C> {
    fn conv3x3(x: Tracked, w: Tracked) -> Tracked {
        let y = Flex::conv3x3(x.primitive().clone(), w.primitive().clone());
        let nodes = [x.node(), w.node()];
        match Conv3.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish((x.into_primitive(), w.into_primitive()), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn conv1x1(x: Tracked, w: Tracked, bias: Tracked) -> Tracked {
        let y = Flex::conv1x1(
            x.primitive().clone(),
            w.primitive().clone(),
            bias.primitive().clone(),
        );
        let nodes = [x.node(), w.node(), bias.node()];
        match Conv1.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish((x.into_primitive(), w.into_primitive()), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn one_hot_conv3x3(bins: IntTensor<Self>, w: Tracked) -> Tracked {
        let y = Flex::one_hot_conv3x3(bins.clone(), w.primitive().clone());
        let [_, channels, ..] = w.primitive().shape().dims::<4>();
        match OneHot.prepare::<C>([w.node()]).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish((bins, channels), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn batch_norm_relu(x: Tracked, gamma: Tracked, beta: Tracked) -> (Tracked, Tracked, Tracked) {
        let inputs = [&x, &gamma, &beta].map(|t| t.primitive().clone());
        let [a, b, c] = inputs.clone();
        let (y, mean, variance) = Flex::batch_norm_relu(a, b, c);
        let nodes = [x.node(), gamma.node(), beta.node()];
        let y = match Norm.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => {
                let [x, gamma, beta] = inputs;
                to.finish([x, gamma, beta, mean.clone(), variance.clone()], y)
            }
            OpsKind::UnTracked(to) => to.finish(y),
        };
        (y, Tracked::new(mean), Tracked::new(variance))
    }

    fn max_pool(x: Tracked) -> Tracked {
        let y = Flex::max_pool(x.primitive().clone());
        match Pool.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish(x.into_primitive(), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn join_upsampled(skip: Tracked, x: Tracked) -> Tracked {
        let [_, channels, ..] = skip.primitive().shape().dims::<4>();
        let y = Flex::join_upsampled(skip.primitive().clone(), x.primitive().clone());
        let nodes = [skip.node(), x.node()];
        match Join.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish(channels, y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn window_attention(qkv: Tracked, bias: Tracked, shape: AttentionShape) -> Tracked {
        let y = Flex::window_attention(qkv.primitive().clone(), bias.primitive().clone(), shape);
        let nodes = [qkv.node(), bias.node()];
        match Attention.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => {
                to.finish((qkv.into_primitive(), bias.into_primitive(), shape), y)
            }
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn gelu(x: Tracked) -> Tracked {
        let y = Flex::gelu(x.primitive().clone());
        match Gelu.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish(x.into_primitive(), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn layer_norm(x: Tracked, gamma: Tracked, beta: Tracked) -> Tracked {
        let inputs = [&x, &gamma, &beta].map(|t| t.primitive().clone());
        let [a, b, c] = inputs.clone();
        let y = Flex::layer_norm(a, b, c);
        let nodes = [x.node(), gamma.node(), beta.node()];
        match Layer.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish(inputs, y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn surround(x: Tracked, moments: usize, volume: bool) -> Tracked {
        let y = Flex::surround(x.primitive().clone(), moments, volume);
        match Surround.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish((moments, volume), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn crop(x: Tracked, bias: Tracked) -> Tracked {
        let y = Flex::crop(x.primitive().clone(), bias.primitive().clone());
        let nodes = [x.node(), bias.node()];
        match Crop.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish((), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn leaky_relu(x: Tracked, slope: f32) -> Tracked {
        let y = Flex::leaky_relu(x.primitive().clone(), slope);
        match Leaky.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish((x.into_primitive(), slope), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    /// Has no gradient, as documented for its users.
    fn taps(x: Tracked, repeated: bool) -> Tracked {
        Tracked::new(Flex::taps(x.into_primitive(), repeated))
    }

    fn adjacent(x: Tracked, moments: usize) -> Tracked {
        let y = Flex::adjacent(x.primitive().clone(), moments);
        match Beside.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(to) => to.finish(moments, y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn halve_time(x: Tracked) -> Tracked {
        let y = Flex::halve_time(x.primitive().clone());
        match HalveTime
            .prepare::<C>([x.node()])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(to) => to.finish(x.into_primitive(), y),
            OpsKind::UnTracked(to) => to.finish(y),
        }
    }

    fn norm_relu(
        x: Tracked,
        gamma: Tracked,
        beta: Tracked,
        mean: Tracked,
        variance: Tracked,
    ) -> Tracked {
        let [x, gamma, beta, mean, variance] =
            [x, gamma, beta, mean, variance].map(Tracked::into_primitive);
        Tracked::new(Flex::norm_relu(x, gamma, beta, mean, variance))
    }

    fn adamw(
        p: Tracked,
        g: Tracked,
        m: Tracked,
        v: Tracked,
        settings: AdamW,
    ) -> (Tracked, Tracked, Tracked) {
        let [p, g, m, v] = [p, g, m, v].map(Tracked::into_primitive);
        let (p, m, v) = Flex::adamw(p, g, m, v, settings);
        (Tracked::new(p), Tracked::new(m), Tracked::new(v))
    }
}
