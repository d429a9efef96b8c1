//! Classes of paths: where on the path light was found, and how.

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
