//! Shapes of furnished rooms, and primitive rooms: a cube, a cylinder and a mirror in a bare room
//! (Shoot-Bounce-3D, appendices B and F.1).

use serde::{Deserialize, Serialize};

/// The shapes of furnished rooms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FloorPlan {
    /// Boxes with closed doors and opaque windows.
    #[default]
    Box,
    /// Half of the rooms are L-shaped. Three of five have an open door to a second room, and three
    /// of five a glazed window.
    Varied,
}

/// The ranges of an object's size, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Width: the two floor sides of a cube, or the diameter of a cylinder.
    pub width_m: [f64; 2],
    /// Height.
    pub height_m: [f64; 2],
}

/// The mirror's wall.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MirrorWall {
    /// Any of the four walls.
    Any,
    /// The wall opposite the camera.
    Back,
    /// There is no mirror.
    None,
}

/// Properties of primitive rooms. Each range is sampled uniformly for every room.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrimitiveRooms {
    /// The room's scale: at 1, it is 3.6 m wide and deep (each ± 10 %) and 2.6 m high.
    pub scale: [f64; 2],
    /// Least and greatest z-depth in the camera's view, metres; views outside are drawn again.
    pub depth_m: [f64; 2],
    /// The horizontal field of view varies by ± this, degrees.
    pub fov_jitter_deg: f64,
    /// The cube.
    pub cube: Sizes,
    /// The cylinder.
    pub cylinder: Sizes,
    /// The mirror.
    pub mirror: Sizes,
    /// The mirror's wall.
    pub mirror_wall: MirrorWall,
    /// Height of the mirror's lower edge above the floor, metres.
    pub mirror_from_m: [f64; 2],
}

impl PrimitiveRooms {
    /// Rooms of the size of living rooms.
    pub const LIVING: Self = Self {
        scale: [0.8, 1.15],
        depth_m: [0.5, 4.5],
        fov_jitter_deg: 5.0,
        cube: Sizes {
            width_m: [0.3, 0.8],
            height_m: [0.3, 0.9],
        },
        cylinder: Sizes {
            width_m: [0.24, 0.7],
            height_m: [0.3, 1.1],
        },
        mirror: Sizes {
            width_m: [0.5, 1.2],
            height_m: [0.5, 1.2],
        },
        mirror_wall: MirrorWall::Any,
        mirror_from_m: [0.3, 0.8],
    };

    /// Boxes on a desk, like those of the laboratory in appendix F: up to 1.4 m deep, with a foam
    /// cube, a cylinder of one inch, and a mirror on the back wall.
    pub const DESKTOP: Self = Self {
        scale: [0.22, 0.34],
        depth_m: [0.3, 1.4],
        fov_jitter_deg: 3.0,
        cube: Sizes {
            width_m: [0.06, 0.16],
            height_m: [0.06, 0.2],
        },
        cylinder: Sizes {
            width_m: [0.0254, 0.0254],
            height_m: [0.1, 0.3],
        },
        mirror: Sizes {
            width_m: [0.12, 0.3],
            height_m: [0.12, 0.3],
        },
        mirror_wall: MirrorWall::Back,
        mirror_from_m: [0.05, 0.2],
    };

    /// Returns every range with its name and its limits.
    fn ranges(&self) -> [(&'static str, [f64; 2], [f64; 2]); 9] {
        let size = [0.005, 5.0];
        [
            ("scale", self.scale, [0.05, 3.0]),
            ("depth_m", self.depth_m, [0.01, 20.0]),
            ("cube.width_m", self.cube.width_m, size),
            ("cube.height_m", self.cube.height_m, size),
            ("cylinder.width_m", self.cylinder.width_m, size),
            ("cylinder.height_m", self.cylinder.height_m, size),
            ("mirror.width_m", self.mirror.width_m, size),
            ("mirror.height_m", self.mirror.height_m, size),
            ("mirror_from_m", self.mirror_from_m, [0.0, 5.0]),
        ]
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// Returns the field and the expected range.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        for (field, [lo, hi], [least, most]) in self.ranges() {
            if !(least <= lo && lo <= hi && hi <= most) {
                let what = format!(
                    "[{lo}, {hi}]: expected a range, the lesser first, within {least} to {most}"
                );
                return Err((field, what));
            }
        }
        match (0.0..=45.0).contains(&self.fov_jitter_deg) {
            true => Ok(()),
            false => Err((
                "fov_jitter_deg",
                format!("{}: expected 0 to 45 degrees", self.fov_jitter_deg),
            )),
        }
    }
}

impl Default for PrimitiveRooms {
    fn default() -> Self {
        Self::LIVING
    }
}
