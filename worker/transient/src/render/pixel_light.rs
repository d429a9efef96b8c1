//! The light paths' contributions to one pixel.

use crate::render::draws::Draw;

/// Σ, Σ of squares, and Σ with alternating sign, over passes.
pub(crate) type Moments = [f32; 3];

/// The contributions of light paths to a pixel, over passes, in metres.
pub(crate) struct Found<'a> {
    pub slots: &'a [u32],
    pub values: &'a [Moments],
    /// Variance by slot, in render units.
    pub variance: &'a [f32],
    /// Σ over the gate of the variance before pooling, and draws of the error if the pixel is
    /// watched; both in metres².
    pub own: (f64, Option<Draw>),
    /// Factors from the sums to the mean and to a draw of its error, and from render units to
    /// metres.
    pub mean: (f64, f64),
    pub noise: f64,
    pub unit: f64,
}

impl Found<'_> {
    /// Returns the bin, the mean, and a draw of the mean's error, for each bin with contributions.
    pub fn light(&self) -> impl Iterator<Item = (usize, f64, f64)> {
        let last = self.variance.len() - 1;
        let each = self.slots.iter().zip(self.values);
        let inside = each.filter(move |(slot, _)| (1..last).contains(&(**slot as usize)));
        inside.map(|(slot, &[sum, _, alternating])| {
            let mean = f64::from(sum) * self.mean.0 / self.mean.1;
            (
                *slot as usize - 1,
                mean,
                f64::from(alternating) * self.noise,
            )
        })
    }

    /// Returns the variance of the mean of each bin of the gate, pooled as in the tiles.
    pub fn variance(&self) -> impl Iterator<Item = f64> {
        let inside = &self.variance[1..self.variance.len() - 1];
        inside.iter().map(|v| f64::from(*v) * self.unit * self.unit)
    }

    /// Returns Σ over the bins of the gate of their variances before pooling, as the tiles do.
    pub fn pixel_variance(&self) -> f64 {
        self.own.0
    }

    /// Returns draws of the pixel's error, if it is watched.
    pub fn draw(&self) -> Option<&Draw> {
        self.own.1.as_ref()
    }
}
