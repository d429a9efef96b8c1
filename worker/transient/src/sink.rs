//! Where goes what walks find, and of which class it is.

use picofarm_scene::Vec3;

use crate::film::Film;

/// Where on its path from the camera a contribution was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place {
    /// On a vertex that a tile's pixels share.
    Shared,
    /// On a walk from such a vertex.
    Walk,
    /// On a gather point.
    Gather,
    /// On a vertex after a gather point that is not shared but followed for one pixel alone.
    Alone,
    /// On a walk from such a vertex.
    AloneWalk,
    /// On the way by near-mirrors to a gather point.
    Mirror,
}

/// How a contribution was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// By connecting to a spot.
    Spot,
    /// By aiming at the image of a spot.
    Image,
    /// By connecting to a surface point that a spot lights.
    Lit,
    /// By connecting to one beyond near-mirrors.
    Beyond,
    /// By connecting to one in the zone of a spot.
    Zone,
}

/// What is found at each place, in each way: the name of a class.
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

/// How many classes there are.
pub(crate) const CLASSES: usize = PLACES.len() * WAYS.len();

/// Index of a class.
#[inline]
pub(crate) fn class(place: Place, way: Way) -> usize {
    place as usize * WAYS.len() + way as usize
}

/// Name of a class by its index.
pub(crate) fn class_name(class: usize) -> String {
    let (place, way) = (PLACES[class / WAYS.len()], WAYS[class % WAYS.len()]);
    format!("{place}, {way}")
}

/// How what is drawn into the image beside the tiles was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Technique {
    /// By light paths by way of near-mirrors.
    Mirrors,
    /// By light paths in the zone of a spot.
    Zone,
    /// By light paths by way of glass.
    Glass,
    /// By camera paths by way of glass and straight legs to the spots, walks from them among those.
    Straight,
    /// By connecting camera paths to images of spots in panes.
    Image,
    /// By connecting them to images of lit points in panes.
    LitImage,
    /// By connecting them to the vertices of light paths by way of glass.
    Vertex,
    /// By the photons of such paths.
    Photon,
    /// A spot that a planar pane shows to the camera.
    SeenSpot,
}

impl Technique {
    /// Whether more light paths alone lessen its variance.
    pub fn is_of_light_paths(self) -> bool {
        matches!(
            self,
            Self::Mirrors | Self::Zone | Self::Glass | Self::Photon
        )
    }
}

/// Their names.
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

/// Takes what a walk finds: optical path in metres, radiance, spot, bounces of the whole path, and how it was found.
pub(crate) trait Sink {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, way: Way);

    /// Where contributions are found from now on.
    fn at(&mut self, place: Place);

    /// From where light arrives at a walk's first vertex by what is added from now on.
    fn toward(&mut self, _: Vec3) {}

    /// The same, for the rest of the walk.
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
