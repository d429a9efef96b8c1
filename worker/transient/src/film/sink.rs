//! Receives the contributions that walks find, by path class.

use picofarm_scene::Vec3;

use crate::film::{
    class::{Place, Way},
    slots::Film,
};

/// Takes what a walk finds: optical path in metres, radiance, spot, bounces of the whole path, and
/// how it was found.
pub(crate) trait Sink {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, way: Way);

    /// Sets the place of the following contributions.
    fn at(&mut self, place: Place);

    /// Sets the direction from which the light of the following contributions arrives at a walk's
    /// first vertex.
    fn toward(&mut self, _: Vec3) {}

    /// Like `toward`, for the rest of the walk.
    fn leave(&mut self, _: Vec3) {}
}

/// A walk's contributions to one pixel.
pub(crate) struct PixelSink<'a> {
    pub film: &'a Film,
    pub pixel: &'a mut [f32],
    pub factor: f32,
    pub place: Place,
}

impl Sink for PixelSink<'_> {
    #[inline]
    fn add(&mut self, path_m: f64, value: f32, spot: usize, _bounces: u32, way: Way) {
        let slot = self.film.slot(path_m);
        let spot = self.film.tag(spot, self.place, way);
        self.film.add(self.pixel, slot, self.factor * value, spot);
    }

    #[inline]
    fn at(&mut self, place: Place) {
        self.place = place;
    }
}
