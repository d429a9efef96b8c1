//! Beams and light paths.

use serde::{Deserialize, Serialize};

/// Beams on their way to a spot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BeamTuning {
    /// Largest number of reflections and refractions of a beam before it is dropped. 64 folds a
    /// beam through any real arrangement of mirrors.
    pub most_turns: u32,
    /// Least share of a beam's light for which a reflection by glass is followed. A pane reflects
    /// 8 %, so two reflections are followed and the third is not.
    pub least_branch: f32,
}

impl Default for BeamTuning {
    fn default() -> Self {
        Self {
            most_turns: 64,
            least_branch: 1.0 / 256.0,
        }
    }
}

/// Images of spots in planar near-mirrors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MirrorTuning {
    /// Largest number of planes. A scene with more facets counts as having curved mirrors.
    pub most_planes: usize,
    /// Planes below this share of the whole mirror area are left to plain sampling.
    pub least_share: f64,
    /// Factor by which the sampled lobe is wider than the real one, so that the tail is sampled
    /// too.
    pub widen: f32,
    /// Margin around the mirror's rectangle within which images still count, in units of the lobe's
    /// width.
    pub margin: f32,
}

impl Default for MirrorTuning {
    fn default() -> Self {
        Self {
            most_planes: 8,
            least_share: 0.02,
            widen: 1.2,
            margin: 3.0,
        }
    }
}

/// Near-mirrors that gather points aim at.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReflectorTuning {
    /// Largest number of triangles. The table of a tile with more would cost more than it gains.
    pub most: usize,
    /// Gather points of a tile that triangles are weighed from. With 1 and 16, error² × CPU time is
    /// within 3 %.
    pub seen_from: usize,
    /// Aims per pixel. Error² × CPU time is within 5 % for 0.25 to 1 (furnished rooms with mirrors,
    /// 25 spots, 256×256). With five spots or fewer, aims gain no more than they cost, and there
    /// are none.
    pub aims: f32,
}

impl Default for ReflectorTuning {
    fn default() -> Self {
        Self {
            most: 4096,
            seen_from: 4,
            aims: 0.5,
        }
    }
}

/// Light paths by near-mirrors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CausticTuning {
    /// Events of a light path before Russian roulette starts.
    pub sure: u32,
    /// Largest ratio by which the near-mirror in which the camera sees a light path's end may be
    /// smoother than the path's first near-mirror. Camera paths sample such light less often the
    /// smoother the first near-mirror is, and connections less often the smoother the other one is.
    /// But connections test thousands of pairs.
    pub smoother: f32,
    /// Paths of the probe that decides whether light paths pay.
    pub probe: u32,
    /// Share of the spots' power by near-mirrors from which light paths pay. In a furnished room
    /// with a share of 8·10⁻⁴ to 1.6·10⁻³ (the upper edge of a mirror on the wall, 2 mm deep),
    /// chance found a path that carried 0.7 % of the image's light to one pixel; light paths cost
    /// 2 % of the time there at 64×64 and 10 % at 24×24. With a share of 1.4·10⁻⁴ no such path was
    /// seen.
    pub pays: f64,
    /// Light paths drawn into the image, per pass and pixel.
    pub paths: f64,
}

impl CausticTuning {
    /// Returns the roughness that the first near-mirror of light paths must be below for them to
    /// pay, if the camera sees their end in a near-mirror of roughness `alpha`.
    #[inline]
    pub(crate) fn pays_below(&self, alpha: f32) -> f32 {
        self.smoother * alpha
    }
}

impl Default for CausticTuning {
    fn default() -> Self {
        Self {
            sure: 3,
            smoother: 16.0,
            probe: 4096,
            pays: 3e-4,
            paths: 4.0,
        }
    }
}

/// Light paths near spots that are close to other surfaces: in the spots' zones.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ContactTuning {
    /// A spot gets a zone if a surface is nearer than at most this share of its distance from the
    /// camera. Without a zone, the light of the spot on that surface is sampled by walks that come
    /// close to it, and only by chance if a near-mirror comes before. In rooms with a spot 10 cm
    /// from a box, this was most of the variance.
    pub near: f32,
    /// Like `near`, for zones in which light paths also sample light of two bounces.
    pub close: f32,
    /// Number of spots above which fewer zones are better, because each spot has a small share of
    /// the light. For 25 spots in furnished rooms with as many zones as for 5 spots, error² × CPU
    /// time is 1.05 to 1.3 of its value without those zones. Spots are counted by their places.
    pub few: f32,
    /// Share of a spot's light that must stay in its zone for the zone to be used.
    pub much: f32,
    /// Inner radius of a zone, in units of the distance to the other surface.
    pub radius: f32,
    /// Least inner radius, in units of the distance from the camera.
    pub least_range: f32,
    /// Greatest inner radius, in units of the distance from the camera. Error² × CPU time varies by
    /// less than a tenth for 1/12 to 1/8.
    pub most_range: f32,
    /// Least inner radius, render units.
    pub least: f32,
    /// Outer radius in units of the inner one, so that connections from vertices near the middle to
    /// others have a minimum length.
    pub outer: f32,
    /// Vertices of a light path before Russian roulette starts.
    pub sure: u32,
    /// Light paths for the light vertices of a tile's pass, in all zones.
    pub tile_paths: u32,
    /// Least number of those in one zone.
    pub least_tile_paths: u32,
    /// Greatest number of those in one zone.
    pub most_tile_paths: u32,
    /// Largest number of light vertices in zones that a near-mirror is connected to.
    pub by_mirrors: u32,
    /// Divisor of the pixels that gives the light paths of a pass that are drawn into the image, in
    /// all zones.
    pub pixels_per_path: u32,
    /// Least number of those in one zone.
    pub least_paths: u32,
    /// Greatest number of those in one zone.
    pub most_paths: u32,
}

impl Default for ContactTuning {
    fn default() -> Self {
        Self {
            near: 1.0 / 12.0,
            close: 1.0 / 64.0,
            few: 5.0,
            much: 1.0 / 32.0,
            radius: 8.0,
            least_range: 1.0 / 64.0,
            most_range: 1.0 / 10.0,
            least: 1.0 / 256.0,
            outer: 1.8,
            sure: 4,
            tile_paths: 64,
            least_tile_paths: 4,
            most_tile_paths: 16,
            by_mirrors: 2,
            pixels_per_path: 4,
            least_paths: 256,
            most_paths: 1024,
        }
    }
}
