//! The techniques that draw into the image outside the tiles.

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
