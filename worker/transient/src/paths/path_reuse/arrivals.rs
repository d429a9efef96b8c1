//! The light that arrives at shared vertices.

use picofarm_scene::Vec3;

use crate::{
    film::{
        class::{Place, Way},
        sink::Sink,
        slots::Film,
    },
    numeric::lanes::SIDE,
    paths::path_reuse::shared::Guide,
};

/// The light that arrives at shared vertices and is scattered on, per unit solid angle, to every
/// side.
///
/// The arrivals of a vertex begin at a group of [`SIDE`], and its last group is padded with zeros.
#[derive(Debug, Default)]
pub(crate) struct Arrivals {
    /// Optical path length from the laser, in bins.
    pub bins: Vec<f32>,
    pub value: Vec<f32>,
    pub spot: Vec<u16>,
    /// Bounces of the whole path if the gather point is the first.
    pub bounces: Vec<u8>,
    /// Unit direction of arrival at a rough vertex; unspecified at other vertices.
    pub from: Vec<Vec3>,
}

impl Arrivals {
    pub fn clear(&mut self) {
        self.bins.clear();
        self.value.clear();
        self.spot.clear();
        self.bounces.clear();
        self.from.clear();
    }

    /// Pads the last group and returns the number of arrivals.
    pub fn fill_up(&mut self) -> usize {
        let whole = self.bins.len().next_multiple_of(SIDE);
        self.bins.resize(whole, 0.0);
        self.value.resize(whole, 0.0);
        self.spot.resize(whole, 0);
        self.bounces.resize(whole, 0);
        self.from.resize(whole, Vec3::ZERO);
        whole
    }
}

/// Adds arrivals, with path lengths relative to `base_m`.
pub(crate) struct ArrivalSink<'a> {
    pub list: &'a mut Arrivals,
    pub base_m: f64,
    pub per_metre: f64,
    pub factor: f32,
    pub film: &'a Film,
    pub place: Place,
    /// The guide by which it was drawn at a rough vertex.
    pub guide: Option<Guide>,
    /// The factor from the value as drawn to the value for the vertex.
    pub share: f32,
    pub from: Vec3,
    /// True if `from` is the direction of a walk's first step and no longer changes.
    pub left: bool,
}

impl Sink for ArrivalSink<'_> {
    #[inline]
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, way: Way) {
        let spot = self.film.tag(spot, self.place, way);
        let list = &mut *self.list;
        list.bins
            .push(((path_m - self.base_m) * self.per_metre) as f32);
        list.value.push(self.factor * self.share * value);
        list.spot.push(spot as u16);
        list.bounces.push(bounces.min(255) as u8);
        list.from.push(self.from);
    }

    #[inline]
    fn toward(&mut self, w: Vec3) {
        if !self.left {
            self.from = w;
            self.share = self.guide.as_ref().map_or(1.0, |g| g.share(w));
        }
    }

    #[inline]
    fn leave(&mut self, w: Vec3) {
        self.toward(w);
        self.left = true;
    }

    #[inline]
    fn at(&mut self, place: Place) {
        self.place = place;
    }
}
