//! The cost of a pass: multiply-adds, computed from the shape alone. Norms, activations, softmax
//! and pooling are not counted.

use super::{
    nlost,
    spec::{Architecture, NetSpec, StemForm},
    swinir, unet25d,
};

impl NetSpec {
    /// Returns the multiply-adds of a forward pass over an image of `side`² pixels. One-hot
    /// channels count as dense ones.
    pub fn multiply_adds(&self, side: usize) -> f64 {
        match self.architecture {
            Architecture::Unet2d => self.of_unet2d(side),
            Architecture::Unet25d => self.of_unet25d(side),
            Architecture::Swinir => self.of_swinir(side),
            Architecture::Embeddings => self.of_embeddings(side),
            Architecture::Nlost => self.of_nlost(side),
        }
    }

    fn of_unet2d(&self, side: usize) -> f64 {
        let of = |inputs: usize, outputs: usize, level: usize| {
            let pixels = (side >> level).pow(2);
            (9 * inputs * outputs * pixels) as f64
        };
        let mut inputs = self.dense + self.one_hot;
        let mut sum = 0.0;
        if self.stem > 0 {
            sum += match self.stem_form {
                StemForm::Block => of(inputs, self.stem, 0),
                StemForm::Linear => of(inputs, self.stem, 0) / 9.0,
            };
            inputs = self.stem;
        }
        for (level, width) in self.widths().iter().enumerate() {
            let between = inputs.max(width / 2);
            sum += of(inputs, between, level) + of(between, *width, level);
            inputs = *width;
        }
        sum + self.of_decoder(side)
    }

    /// The 2D decoder of both U-Nets.
    fn of_decoder(&self, side: usize) -> f64 {
        let mut sum = 0.0;
        for (level, pair) in self.widths().windows(2).enumerate() {
            let pixels = (side >> level).pow(2);
            sum += (9 * (pair[0] + pair[1] + pair[0]) * pair[0] * pixels) as f64;
        }
        sum + (self.width * self.outputs * side * side) as f64
    }

    fn of_unet25d(&self, side: usize) -> f64 {
        let streams = self.streams();
        let mut sum = (streams * self.dense * self.time * side * side) as f64;
        let mut inputs = streams;
        for (level, width) in self.widths().into_iter().enumerate() {
            let (pixels, time) = ((side >> level).pow(2), self.time >> level);
            let between = inputs.max(width / 2);
            sum += (27 * (inputs + width) * between * pixels * time) as f64;
            let sizes = unet25d::steps(time);
            let over_time: usize = sizes.windows(2).map(|pair| pair[0] * pair[1]).sum();
            sum += (over_time * width * pixels) as f64;
            inputs = width;
        }
        sum + self.of_decoder(side)
    }

    /// The part that halves time, rows and columns: a filter for each stream, a convolution to
    /// `width` channels, and four others.
    fn of_downsample(&self, side: usize, width: usize) -> f64 {
        let streams = self.streams();
        let voxel = 27 * (streams + streams * width + 4 * width * width);
        (voxel * self.dense.div_ceil(2) * (side / 2).pow(2)) as f64
    }

    /// The part from a volume of `channels`, with half as many rows and columns, to the output.
    fn of_rendering(&self, side: usize, channels: usize) -> f64 {
        let (pixels, coarse) = (side * side, (side / 2).pow(2));
        let (features, outputs) = (2 * channels, self.outputs);
        let images = 9 * 5 * features * features * coarse;
        let fine = (features + outputs) * 2 * features + 16 * features * features;
        let fine = 9 * (fine + 2 * features * outputs) + 2 * outputs;
        (images + fine * pixels) as f64
    }

    fn of_embeddings(&self, side: usize) -> f64 {
        let (streams, width) = (self.streams(), self.width);
        self.of_downsample(side, width) + self.of_rendering(side, width + streams)
    }

    fn of_nlost(&self, side: usize) -> f64 {
        let (c, features) = (self.width, self.streams() + nlost::FIRST);
        let [_, second, third, fourth, fifth] = nlost::moments(self.dense);
        let (pixels, coarse) = ((side / 2).pow(2), (side / 4).pow(2));
        let part = c / 4;
        let scales = 27 * 2 * (features * part + part * part) * second;
        let halved = 27 * 6 * c * c * third;
        let embedded = 125 * c * c * fourth + (125 + 1) * c * c * fifth;
        // Queries, keys, values and the output layers over the image and over time; scores and the
        // weighted sums of values.
        let attention = |tokens: usize| {
            let layers = (8 + 2 * nlost::BETWEEN) * c * c;
            (layers + 2 * (tokens + fifth) * c) * fifth
        };
        let near = 27 * c * c * fifth + attention(nlost::WINDOW.pow(2));
        let far = (125 + 27) * c * c * fifth + attention(coarse);
        let upwards = 27 * c * c * fifth;
        let sums = 2 * (3 * c * c + c * c / nlost::groups(c) + 2 * c);
        let decoders = 2 * (sums + 2 * nlost::BETWEEN * c * c) * fifth;
        let over_time = 27 * (c * c / 2 * 2 + c * c / 8 * 4 + c * c / 4 * 8) * fifth;
        let joined = 27 * (3 * c * c + c * features) * second;
        let of_pixel =
            scales + halved + embedded + near + upwards + decoders + 2 * over_time + joined;
        self.of_downsample(side, nlost::FIRST)
            + (of_pixel * pixels + far * coarse) as f64
            + self.of_rendering(side, features)
    }

    fn of_swinir(&self, side: usize) -> f64 {
        let (e, swin) = (self.width, &self.swin);
        let convolutions =
            self.dense + self.one_hot + e * (swin.groups as usize + 1) + self.outputs;
        let tokens = (swin.window as usize).pow(2);
        // Queries, keys, values and the output layer; the perceptron; scores and the weighted sums
        // of values.
        let block = 4 * e * e + 2 * swinir::BETWEEN * e * e + 2 * tokens * e;
        let blocks = (swin.groups * swin.depth) as usize;
        ((9 * e * convolutions + blocks * block) * side * side) as f64
    }
}
