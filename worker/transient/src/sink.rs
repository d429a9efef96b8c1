//! Receives the contributions that walks find, by path class.

use picofarm_scene::Vec3;

use crate::film::Film;

/// The place on the path from the camera at which a contribution was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place {
    /// At a vertex that a tile's pixels share.
    Shared,
    /// On a walk from a shared vertex.
    Walk,
    /// At a gather point.
    Gather,
    /// At a vertex after a gather point, not shared but traced for one pixel alone.
    Alone,
    /// On a walk from a vertex of one pixel.
    AloneWalk,
    /// Between the camera and a gather point, on the near-mirrors.
    Mirror,
}

/// The technique that found a contribution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// By connecting to a spot.
    Spot,
    /// By aiming at the image of a spot.
    Image,
    /// By connecting to a surface point lit by a spot.
    Lit,
    /// By connecting to a lit surface point beyond near-mirrors.
    Beyond,
    /// By connecting to a lit surface point in the zone of a spot.
    Zone,
}

/// The names of places and techniques. A pair of them names a class.
const PLACES: [&str; 6] = [
    "shared vertex",
    "walk from a shared vertex",
    "gather point",
    "vertex of one pixel",
    "walk from a vertex of one pixel",
    "near-mirror before the gather point",
];
const WAYS: [&str; 5] = [
    "spot",
    "mirror image",
    "lit point",
    "point beyond near-mirrors",
    "point in a zone",
];

/// The number of classes.
pub(crate) const CLASSES: usize = PLACES.len() * WAYS.len();

/// Returns the index of a class.
#[inline]
pub(crate) fn class(place: Place, way: Way) -> usize {
    place as usize * WAYS.len() + way as usize
}

/// Returns the name of a class by its index.
pub(crate) fn class_name(class: usize) -> String {
    let (place, way) = (PLACES[class / WAYS.len()], WAYS[class % WAYS.len()]);
    format!("{place}, {way}")
}

/// The technique of a contribution drawn into the image outside the tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Technique {
    /// By light paths via near-mirrors.
    Mirrors,
    /// By light paths in the zone of a spot.
    Zone,
    /// By light paths via glass.
    Glass,
    /// By camera paths via glass and straight segments to the spots, including walks from them.
    Straight,
    /// By connecting camera paths to images of spots in panes.
    Image,
    /// By connecting camera paths to images of lit points in panes.
    LitImage,
    /// By connecting camera paths to the vertices of light paths via glass.
    Vertex,
    /// By the photons of light paths via glass.
    Photon,
    /// A spot that a planar pane shows to the camera.
    SeenSpot,
}

impl Technique {
    /// Returns whether only more light paths reduce the variance.
    pub fn is_of_light_paths(self) -> bool {
        matches!(
            self,
            Self::Mirrors | Self::Zone | Self::Glass | Self::Photon
        )
    }
}

/// Names of the techniques.
pub(crate) const TECHNIQUES: [&str; 9] = [
    "light path by near-mirrors",
    "light path in a zone",
    "light path by glass",
    "camera path by glass, spot or lit point",
    "camera path, image of a spot in a pane",
    "camera path, image of a lit point in a pane",
    "camera path by glass, light path by glass",
    "camera path by glass, photon",
    "spot seen in a pane",
];

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
