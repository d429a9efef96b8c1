//! The kernels as operations of burn's CPU backend.

use burn::{
    backend::{
        Backend, Flex, TensorMetadata, backend_extension,
        tensor::{FloatTensor, IntTensor},
    },
    tensor::{Shape, TensorData},
};

use super::EPSILON;
use crate::kernel::{
    AdamW, AttentionShape, BatchNorm, BorderShape, ConvShape, Kernels, LayerNorm, MomentShape,
    NormShape, OneHotShape, PlaneShape, TapShape,
};

/// The operations of networks; shapes as in [`super`].
#[backend_extension(Flex, Autodiff)]
pub trait NetOps: Backend {
    fn conv3x3(x: FloatTensor<Self>, w: FloatTensor<Self>) -> FloatTensor<Self>;
    fn conv1x1(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        bias: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
    fn one_hot_conv3x3(bins: IntTensor<Self>, w: FloatTensor<Self>) -> FloatTensor<Self>;
    fn batch_norm_relu(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
    fn norm_relu(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
    fn max_pool(x: FloatTensor<Self>) -> FloatTensor<Self>;
    fn join_upsampled(skip: FloatTensor<Self>, x: FloatTensor<Self>) -> FloatTensor<Self>;
    fn window_attention(
        qkv: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        shape: AttentionShape,
    ) -> FloatTensor<Self>;
    fn gelu(x: FloatTensor<Self>) -> FloatTensor<Self>;
    fn layer_norm(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
    fn surround(x: FloatTensor<Self>, moments: usize, volume: bool) -> FloatTensor<Self>;
    fn crop(x: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self>;
    fn leaky_relu(x: FloatTensor<Self>, slope: f32) -> FloatTensor<Self>;
    fn taps(x: FloatTensor<Self>, repeated: bool) -> FloatTensor<Self>;
    fn adjacent(x: FloatTensor<Self>, moments: usize) -> FloatTensor<Self>;
    fn halve_time(x: FloatTensor<Self>) -> FloatTensor<Self>;
    fn adamw(
        p: FloatTensor<Self>,
        g: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        settings: AdamW,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
}

/// A tensor of the CPU backend.
pub(super) type Cpu = FloatTensor<Flex>;

pub(super) fn dims<const D: usize>(x: &Cpu) -> [usize; D] {
    x.shape().dims()
}

/// Returns the values in order. They are copied only if they are stored in another order.
pub(super) fn contiguous(x: Cpu) -> Cpu {
    match x.as_slice::<f32>() {
        Some(_) => x,
        None => x.to_contiguous(),
    }
}

pub(super) fn values(x: &Cpu) -> &[f32] {
    x.as_slice()
        .expect("made contiguous, and networks compute in f32")
}

pub(super) fn tensor<const D: usize>(values: Vec<f32>, dims: [usize; D]) -> Cpu {
    Cpu::from_data(TensorData::new(values, Shape::from(dims)))
}

/// Creates a tensor; `fill` writes all its values.
pub(super) fn made<const D: usize>(dims: [usize; D], fill: impl FnOnce(&mut [f32])) -> Cpu {
    let mut out = vec![0.0; dims.iter().product()];
    fill(&mut out);
    tensor(out, dims)
}

/// Like [`made`], with the shape of another tensor of any rank.
pub(super) fn alike(like: &Cpu, fill: impl FnOnce(&mut [f32])) -> Cpu {
    let shape = like.shape();
    let mut out = vec![0.0; shape.num_elements()];
    fill(&mut out);
    Cpu::from_data(TensorData::new(out, shape))
}

pub(super) fn conv_shape(
    [images, _, height, width]: [usize; 4],
    inputs: usize,
    outputs: usize,
) -> ConvShape {
    ConvShape {
        images,
        inputs,
        outputs,
        height,
        width,
    }
}

pub(super) fn norm_shape([images, channels, height, width]: [usize; 4]) -> NormShape {
    NormShape {
        images,
        channels,
        pixels: height * width,
    }
}

pub(super) fn planes([n, c, height, width]: [usize; 4]) -> PlaneShape {
    PlaneShape {
        planes: n * c,
        height,
        width,
    }
}

/// Returns the parameters of a layer norm.
pub(super) fn layer<'a>(gamma: &'a Cpu, beta: &'a Cpu) -> LayerNorm<'a> {
    LayerNorm {
        gamma: values(gamma),
        beta: values(beta),
        eps: EPSILON as f32,
    }
}

/// Returns the shape of images without their border, grouped into volumes of `moments`.
pub(super) fn border_shape(
    [images, channels, height, width]: [usize; 4],
    moments: usize,
    volume: bool,
) -> BorderShape {
    BorderShape {
        images,
        moments,
        volume,
        channels,
        height,
        width,
    }
}

/// Returns the shape of images of `moments` each.
pub(super) fn moment_shape([all, c, h, w]: [usize; 4], moments: usize) -> MomentShape {
    MomentShape {
        images: all / moments,
        moments,
        values: c * h * w,
    }
}

/// Converts bins to the format that the kernels read.
pub(super) fn bins(bins: IntTensor<Flex>) -> Vec<u16> {
    let data = bins.into_data();
    data.iter::<i64>()
        .map(|bin| u16::try_from(bin).unwrap_or(u16::MAX))
        .collect()
}

pub(super) fn one_hot_shape([images, height, width]: [usize; 3], w: [usize; 4]) -> OneHotShape {
    OneHotShape {
        images,
        bins: w[1],
        outputs: w[0],
        height,
        width,
    }
}

/// Returns the tensor's own memory if there are no other references to it.
fn owned(x: Cpu) -> Vec<f32> {
    let x = contiguous(x);
    x.into_data()
        .try_into_vec()
        .expect("networks compute in f32")
}

impl NetOps for Flex {
    fn conv3x3(x: Cpu, w: Cpu) -> Cpu {
        let (x, w) = (contiguous(x), contiguous(w));
        let ([n, c, h, wide], [o, ..]) = (dims(&x), dims::<4>(&w));
        let s = conv_shape([n, c, h, wide], c, o);
        made([n, o, h, wide], |out| {
            Kernels::best().conv3x3(&s, values(&x), values(&w), out);
        })
    }

    fn conv1x1(x: Cpu, w: Cpu, bias: Cpu) -> Cpu {
        let (x, w, bias) = (contiguous(x), contiguous(w), contiguous(bias));
        let ([n, c, h, wide], [o, ..]) = (dims(&x), dims::<4>(&w));
        let s = conv_shape([n, c, h, wide], c, o);
        made([n, o, h, wide], |out| {
            let bias = Some(values(&bias));
            Kernels::best().conv1x1(&s, values(&x), values(&w), bias, out);
        })
    }

    fn one_hot_conv3x3(at: IntTensor<Self>, w: Cpu) -> Cpu {
        let w = contiguous(w);
        let [n, h, wide] = at.shape().dims();
        let s = one_hot_shape([n, h, wide], dims(&w));
        let bins = bins(at);
        made([n, s.outputs, h, wide], |out| {
            Kernels::best().onehot_conv3x3(&s, &bins, values(&w), out);
        })
    }

    fn batch_norm_relu(x: Cpu, gamma: Cpu, beta: Cpu) -> (Cpu, Cpu, Cpu) {
        let (x, gamma, beta) = (contiguous(x), contiguous(gamma), contiguous(beta));
        let at = dims::<4>(&x);
        let (mut mean, mut variance) = (vec![0.0; at[1]], vec![0.0; at[1]]);
        let y = made(at, |y| {
            Kernels::best().batch_norm_relu(
                &norm_shape(at),
                values(&x),
                values(&gamma),
                values(&beta),
                EPSILON as f32,
                y,
                &mut mean,
                &mut variance,
            );
        });
        (y, tensor(mean, [at[1]]), tensor(variance, [at[1]]))
    }

    fn norm_relu(x: Cpu, gamma: Cpu, beta: Cpu, mean: Cpu, variance: Cpu) -> Cpu {
        let x = contiguous(x);
        let [gamma, beta, mean, variance] = [gamma, beta, mean, variance].map(contiguous);
        let at = dims::<4>(&x);
        let norm = BatchNorm {
            gamma: values(&gamma),
            beta: values(&beta),
            mean: values(&mean),
            var: values(&variance),
            eps: EPSILON as f32,
        };
        made(at, |y| {
            Kernels::best().norm_relu(&norm_shape(at), values(&x), &norm, y);
        })
    }

    fn max_pool(x: Cpu) -> Cpu {
        let x = contiguous(x);
        let [n, c, h, w] = dims(&x);
        let s = planes([n, c, h, w]);
        let mut which = vec![0; s.halved().len()];
        made([n, c, h / 2, w / 2], |y| {
            Kernels::best().max_pool(&s, values(&x), y, &mut which);
        })
    }

    fn join_upsampled(skip: Cpu, x: Cpu) -> Cpu {
        let (skip, x) = (contiguous(skip), contiguous(x));
        let ([n, c, h, w], small) = (dims(&skip), dims::<4>(&x));
        let [_, d, ..] = small;
        let s = planes([1, d, small[2], small[3]]);
        made([n, c + d, h, w], |out| {
            let images = out.chunks_exact_mut((c + d) * h * w);
            let inputs = values(&skip)
                .chunks_exact(c * h * w)
                .zip(values(&x).chunks_exact(s.len()));
            for (out, (skip, x)) in images.zip(inputs) {
                let (first, rest) = out.split_at_mut(c * h * w);
                first.copy_from_slice(skip);
                Kernels::best().upsample(&s, x, rest);
            }
        })
    }

    fn window_attention(qkv: Cpu, bias: Cpu, s: AttentionShape) -> Cpu {
        let (qkv, bias) = (contiguous(qkv), contiguous(bias));
        made([s.images, s.height, s.width, s.channels()], |out| {
            Kernels::best().window_attention(&s, values(&qkv), values(&bias), out);
        })
    }

    fn gelu(x: Cpu) -> Cpu {
        let x = contiguous(x);
        alike(&x, |y| Kernels::best().gelu(values(&x), y))
    }

    fn layer_norm(x: Cpu, gamma: Cpu, beta: Cpu) -> Cpu {
        let (x, gamma, beta) = (contiguous(x), contiguous(gamma), contiguous(beta));
        let norm = layer(&gamma, &beta);
        alike(&x, |y| Kernels::best().layer_norm(&norm, values(&x), y))
    }

    fn surround(x: Cpu, moments: usize, volume: bool) -> Cpu {
        let x = contiguous(x);
        let [n, c, h, w] = dims(&x);
        let s = border_shape([n, c, h, w], moments, volume);
        let parts = if volume { 3 } else { 1 };
        made([n, parts * c, h + 2, w + 2], |out| {
            Kernels::best().surround(&s, values(&x), out);
        })
    }

    fn crop(x: Cpu, bias: Cpu) -> Cpu {
        let (x, bias) = (contiguous(x), contiguous(bias));
        let [n, c, h, w] = dims(&x);
        let at = [n, c, h - 2, w - 2];
        let s = border_shape(at, 1, false);
        made(at, |out| {
            Kernels::best().crop(&s, values(&x), values(&bias), out);
        })
    }

    fn leaky_relu(x: Cpu, slope: f32) -> Cpu {
        let x = contiguous(x);
        alike(&x, |y| Kernels::best().leaky_relu(slope, values(&x), y))
    }

    fn taps(x: Cpu, repeated: bool) -> Cpu {
        let x = contiguous(x);
        let [images, moments, streams, height, width] = dims(&x);
        let s = TapShape {
            images,
            moments,
            streams,
            height,
            width,
            repeated,
        };
        let [t, h, w] = s.halved();
        made([images * t, 27 * streams, h, w], |out| {
            Kernels::best().taps(&s, values(&x), out);
        })
    }

    fn adjacent(x: Cpu, moments: usize) -> Cpu {
        let x = contiguous(x);
        let [n, c, h, w] = dims(&x);
        let s = moment_shape([n, c, h, w], moments);
        made([n, 3 * c, h, w], |out| {
            Kernels::best().adjacent(&s, values(&x), out);
        })
    }

    fn halve_time(x: Cpu) -> Cpu {
        let x = contiguous(x);
        let [n, c, h, w] = dims(&x);
        let s = moment_shape([n, c, h, w], 2);
        made([n / 2, c, h, w], |y| {
            Kernels::best().halve_time(&s, values(&x), y);
        })
    }

    fn adamw(p: Cpu, g: Cpu, m: Cpu, v: Cpu, settings: AdamW) -> (Cpu, Cpu, Cpu) {
        let g = contiguous(g);
        let (mut p, mut m, mut v) = (owned(p), owned(m), owned(v));
        Kernels::best().adamw(&settings, &mut p, values(&g), &mut m, &mut v);
        let at = [p.len()];
        (tensor(p, at), tensor(m, at), tensor(v, at))
    }
}
