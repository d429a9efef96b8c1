//! What a pass costs: multiply-adds, counted from the shape alone. Norms, activations, softmax and pooling are not counted.

use super::{
    spec::{Architecture, NetSpec, StemForm},
    swinir, unet25d,
};

impl NetSpec {
    /// Multiply-adds of a pass forward over an image of `side`² pixels, one-hot channels counted as dense ones.
    pub fn multiply_adds(&self, side: usize) -> f64 {
        match self.architecture {
            Architecture::Unet2d => self.of_unet2d(side),
            Architecture::Unet25d => self.of_unet25d(side),
            Architecture::Swinir => self.of_swinir(side),
            Architecture::Embeddings => self.of_embeddings(side),
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

    fn of_embeddings(&self, side: usize) -> f64 {
        let (streams, width, outputs) = (self.streams(), self.width, self.outputs);
        let (pixels, coarse) = (side * side, (side / 2).pow(2));
        // The box filters, the first convolution, four others.
        let voxel = 27 * (streams + streams * width + 4 * width * width);
        let features = 2 * (width + streams);
        let volume = voxel * self.dense.div_ceil(2) * coarse;
        let images = 9 * 5 * features * features * coarse;
        let fine = (features + outputs) * 2 * features + 16 * features * features;
        let fine = 9 * (fine + 2 * features * outputs) + 2 * outputs;
        (volume + images + fine * pixels) as f64
    }

    fn of_swinir(&self, side: usize) -> f64 {
        let (e, swin) = (self.width, &self.swin);
        let convolutions =
            self.dense + self.one_hot + e * (swin.groups as usize + 1) + self.outputs;
        let tokens = (swin.window as usize).pow(2);
        // Queries, keys, values and what follows from them; the perceptron; scores and their sums of values.
        let block = 4 * e * e + 2 * swinir::BETWEEN * e * e + 2 * tokens * e;
        let blocks = (swin.groups * swin.depth) as usize;
        ((9 * e * convolutions + blocks * block) * side * side) as f64
    }
}
