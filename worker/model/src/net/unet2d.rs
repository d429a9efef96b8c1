//! The 2D U-Net of Shoot-Bounce-3D: bins are channels.

use burn::tensor::{Int, Tensor};

use super::{
    block::{Block, Cbr, Final, Linear},
    network::Network,
    pass::{Input, Pass},
    spec::{NetSpec, StemForm},
};
use crate::{ops, parameters::Declarations};

/// Encoder blocks with max-pooling between them, and decoder blocks over upsampled features joined
/// with the encoder's.
#[derive(Debug, Clone)]
pub(super) struct Unet2d {
    stem: Option<Stem>,
    encoders: Vec<Block>,
    frozen: bool,
    decoder: Decoder,
}

/// The projection in front of the first level.
#[derive(Debug, Clone, Copy)]
enum Stem {
    Block(Cbr),
    Linear(Linear),
}

/// The decoder.
#[derive(Debug, Clone)]
pub(super) struct Decoder {
    blocks: Vec<Block>,
    last: Final,
}

impl Unet2d {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        d.frozen = spec.frozen;
        let stem = (spec.stem > 0).then(|| Stem::declare(d, spec));
        let (mut inputs, mut one_hot) = match stem {
            Some(_) => (spec.stem, 0),
            None => (spec.dense, spec.one_hot),
        };
        let mut encoders = Vec::new();
        for (i, outputs) in spec.widths().into_iter().enumerate() {
            if is_bottleneck(i, spec.levels) && !spec.frozen {
                d.cut();
            }
            let at = format!("encoders.{i}");
            encoders.push(Block::encoder(d, &at, inputs, one_hot, outputs));
            (inputs, one_hot) = (outputs, 0);
        }
        if !spec.frozen {
            d.cut();
        }
        d.frozen = false;
        Self {
            stem,
            encoders,
            frozen: spec.frozen,
            decoder: Decoder::declare(d, spec),
        }
    }

    /// Returns the encoder's features at each level, from the finest.
    pub(super) fn features(&self, pass: &mut Pass, input: Input) -> Vec<Tensor<4>> {
        let Input { dense, one_hot } = input;
        let mut one_hot = one_hot.as_ref();
        let mut x = dense;
        if let Some(stem) = &self.stem {
            x = stem.forward(pass, x, one_hot.take());
        }
        let mut features = Vec::with_capacity(self.encoders.len());
        for (i, block) in self.encoders.iter().enumerate() {
            if i > 0 {
                x = ops::max_pool(x);
            }
            x = block.forward(pass, x, one_hot.take());
            let (kept, next) = match self.frozen {
                true => (x.clone(), x),
                false => hand_on(pass, i, self.encoders.len(), x),
            };
            features.push(kept);
            x = next;
        }
        features
    }

    pub(super) fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        let features = match self.frozen {
            true => pass.frozen(|pass| self.features(pass, input)),
            false => self.features(pass, input),
        };
        self.decoder.forward(pass, features)
    }
}

impl Network for Unet2d {
    const HAS_ENCODER: bool = true;
    const HAS_STEM: bool = true;
    const ADDS: bool = true;
    const OVER_TIME: bool = false;

    fn build(d: &mut Declarations, spec: &NetSpec) -> Self {
        Self::declare(d, spec)
    }

    fn multiple(spec: &NetSpec) -> (usize, &'static str, String) {
        let what = format!("{} halve the image {} times", spec.levels, spec.levels - 1);
        (1 << (spec.levels - 1), "net.levels", what)
    }

    fn multiply_adds(spec: &NetSpec, side: usize) -> f64 {
        let of = |inputs: usize, outputs: usize, level: usize| {
            let pixels = (side >> level).pow(2);
            (9 * inputs * outputs * pixels) as f64
        };
        let mut inputs = spec.dense + spec.one_hot;
        let mut sum = 0.0;
        if spec.stem > 0 {
            sum += match spec.stem_form {
                StemForm::Block => of(inputs, spec.stem, 0),
                StemForm::Linear => of(inputs, spec.stem, 0) / 9.0,
            };
            inputs = spec.stem;
        }
        for (level, width) in spec.widths().iter().enumerate() {
            let between = inputs.max(width / 2);
            sum += of(inputs, between, level) + of(between, *width, level);
            inputs = *width;
        }
        sum + spec.of_decoder(side)
    }

    fn describe(spec: &NetSpec) -> String {
        format!("2D U-Net, width {}, {} levels", spec.width, spec.levels)
    }

    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        Self::forward(self, pass, input)
    }
}

/// Returns whether a level is the last of an encoder. The last level is a segment of its own, with
/// half of the encoder's parameters and few pixels.
pub(super) fn is_bottleneck(level: usize, levels: usize) -> bool {
    level + 1 == levels
}

/// Passes the features of an encoder level on. Returns the tensors for the decoder and for the next
/// level.
pub(super) fn hand_on(
    pass: &mut Pass,
    level: usize,
    levels: usize,
    x: Tensor<4>,
) -> (Tensor<4>, Tensor<4>) {
    let bottleneck = is_bottleneck(level, levels);
    let seen = pass.hand_on(usize::from(bottleneck), x.clone());
    // The next level belongs to the same segment, unless it is the bottleneck.
    match bottleneck || is_bottleneck(level + 1, levels) {
        true => (seen.clone(), seen),
        false => (seen, x),
    }
}

impl Stem {
    fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        match spec.stem_form {
            StemForm::Block => {
                Self::Block(Cbr::declare(d, "stem", spec.dense, spec.one_hot, spec.stem))
            }
            StemForm::Linear => {
                let inputs = spec.dense + spec.one_hot;
                Self::Linear(Linear::declare(d, "stem", &[spec.stem, inputs, 1, 1]))
            }
        }
    }

    fn forward(
        &self,
        pass: &mut Pass,
        x: Tensor<4>,
        one_hot: Option<&Tensor<3, Int>>,
    ) -> Tensor<4> {
        match self {
            Self::Block(cbr) => cbr.forward(pass, x, one_hot),
            Self::Linear(linear) => {
                let x = match one_hot {
                    Some(bins) => {
                        let channels = linear.inputs(pass) - x.dims()[1];
                        Tensor::cat(vec![x, ops::plain::one_hot(bins.clone(), channels)], 1)
                    }
                    None => x,
                };
                linear.forward(pass, x)
            }
        }
    }
}

impl Decoder {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        let widths = spec.widths();
        let mut blocks = Vec::new();
        for (i, level) in (0..widths.len() - 1).rev().enumerate() {
            let (fine, coarse) = (widths[level], widths[level + 1]);
            blocks.push(Block::decoder(
                d,
                &format!("decoders.{i}"),
                fine + coarse,
                fine,
            ));
        }
        Self {
            blocks,
            last: Final::declare(d, widths[0], spec.outputs, spec.added),
        }
    }

    /// Computes the output from the features at each level, from the finest.
    pub(super) fn forward(&self, pass: &mut Pass, mut features: Vec<Tensor<4>>) -> Tensor<4> {
        let mut x = features.pop().expect("there are at least two levels");
        for block in &self.blocks {
            let skip = features.pop().expect("as many levels as blocks and one");
            x = block.forward(pass, ops::join_upsampled(skip, x), None);
        }
        self.last.forward(pass, x)
    }
}
