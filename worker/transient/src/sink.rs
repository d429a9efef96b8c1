//! Where goes what walks find.

use crate::film::Film;

/// Takes what a walk finds: optical path in metres, value, spot, bounces of the whole path.
pub(crate) trait Sink {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32);
}

/// A walk's contributions to one pixel.
pub(crate) struct PixelSink<'a> {
    pub film: &'a Film,
    pub pixel: &'a mut [f32],
    pub factor: f32,
}

impl Sink for PixelSink<'_> {
    #[inline]
    fn add(&mut self, path_m: f64, value: f32, spot: usize, _bounces: u32) {
        let slot = self.film.slot(path_m);
        self.film.add(self.pixel, slot, self.factor * value, spot);
    }
}
