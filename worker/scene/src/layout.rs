//! Plan geometry: the room's rectangle, and upright boxes that must not overlap.

use std::f32::consts::{FRAC_PI_2, PI};

use crate::{Material, Mesh, Vec3, shape::Shape};

/// A rectangular room centred on the origin, its floor at y = 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Room {
    /// The extent along x, metres.
    pub(crate) width: f32,
    /// The extent along z, metres.
    pub(crate) depth: f32,
    /// The height, metres.
    pub(crate) height: f32,
}

/// An upright box: an oriented rectangle on the plan and an interval of heights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Footprint {
    centre: [f32; 2],
    axes: [[f32; 2]; 2],
    half: [f32; 2],
    heights: [f32; 2],
}

/// The tolerance within which boxes may touch without overlapping, metres.
const TOUCH: f32 = 1e-4;

impl Footprint {
    /// Returns the box of a model placed at `at` (its bottom centre) and turned by `yaw` about +y.
    pub(crate) fn new(at: [f32; 3], yaw: f32, half: [f32; 2], height: f32) -> Self {
        let (s, c) = (libm::sinf(yaw), libm::cosf(yaw));
        Self {
            centre: [at[0], at[2]],
            axes: [[c, -s], [s, c]],
            half,
            heights: [at[1], at[1] + height],
        }
    }

    /// Returns half of the box's extent along a unit direction of the plan.
    fn reach(&self, [x, z]: [f32; 2]) -> f32 {
        let along = |k: usize| self.half[k] * (self.axes[k][0] * x + self.axes[k][1] * z).abs();
        along(0) + along(1)
    }

    /// Returns whether boxes overlap, by the separating-axis test on the plan and the height
    /// intervals.
    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        if self.heights[1] <= other.heights[0] + TOUCH
            || other.heights[1] <= self.heights[0] + TOUCH
        {
            return false;
        }
        let d = [
            other.centre[0] - self.centre[0],
            other.centre[1] - self.centre[1],
        ];
        self.axes.iter().chain(&other.axes).all(|&axis| {
            let distance = (d[0] * axis[0] + d[1] * axis[1]).abs();
            distance + TOUCH < self.reach(axis) + other.reach(axis)
        })
    }

    /// Returns whether a point is in the box enlarged by `margin` metres.
    pub(crate) fn contains(&self, p: Vec3, margin: f32) -> bool {
        let d = [p.x - self.centre[0], p.z - self.centre[1]];
        let within = |k: usize| {
            (d[0] * self.axes[k][0] + d[1] * self.axes[k][1]).abs() <= self.half[k] + margin
        };
        within(0) && within(1) && p.y >= self.heights[0] - margin && p.y <= self.heights[1] + margin
    }
}

impl Room {
    /// Returns whether the box is inside the walls and under the ceiling.
    pub(crate) fn holds(&self, foot: &Footprint) -> bool {
        foot.centre[0].abs() + foot.reach([1.0, 0.0]) <= self.width * 0.5 - TOUCH
            && foot.centre[1].abs() + foot.reach([0.0, 1.0]) <= self.depth * 0.5 - TOUCH
            && foot.heights[1] <= self.height - TOUCH
    }

    /// Returns the plan position and yaw of a box with its back to wall `k` (−z, +z, −x, +x) and
    /// its front facing the room. `along` in [−1, 1] slides it from corner to corner, and `gap` is
    /// its distance from the wall.
    pub(crate) fn against_wall(
        &self,
        k: usize,
        along: f32,
        half: [f32; 2],
        gap: f32,
    ) -> ([f32; 2], f32) {
        let (x, z) = (self.width * 0.5, self.depth * 0.5);
        // A box in a corner also has the distance `gap` from the side wall.
        let slide = |extent: f32| along * (extent - half[0] - gap).max(0.0);
        let off = half[1] + gap;
        match k {
            0 => ([slide(x), -z + off], 0.0),
            1 => ([slide(x), z - off], PI),
            2 => ([-x + off, slide(z)], FRAC_PI_2),
            _ => ([x - off, slide(z)], -FRAC_PI_2),
        }
    }

    /// Returns the smallest and largest coordinates of the room.
    pub(crate) fn corners(&self) -> [Vec3; 2] {
        let (x, z) = (self.width * 0.5, self.depth * 0.5);
        [Vec3::new(-x, 0.0, -z), Vec3::new(x, self.height, z)]
    }

    /// Returns the six inner faces, each a separate mesh facing inwards, with its label.
    pub(crate) fn shell(
        &self,
        floor: Material,
        ceiling: Material,
        wall: Material,
    ) -> Vec<(&'static str, Mesh)> {
        let (x, z, h) = (self.width * 0.5, self.depth * 0.5, self.height);
        let face = |label: &'static str, material: &Material, corners: [[f32; 3]; 4]| {
            let mut shape = Shape::new(label);
            let m = shape.material(material.clone());
            shape.quad(corners.map(Vec3::from), m);
            (label, shape.finish())
        };
        vec![
            face(
                "floor",
                &floor,
                [[-x, 0., -z], [-x, 0., z], [x, 0., z], [x, 0., -z]],
            ),
            face(
                "ceiling",
                &ceiling,
                [[-x, h, -z], [x, h, -z], [x, h, z], [-x, h, z]],
            ),
            face(
                "wall",
                &wall,
                [[-x, 0., -z], [x, 0., -z], [x, h, -z], [-x, h, -z]],
            ),
            face(
                "wall",
                &wall,
                [[x, 0., z], [-x, 0., z], [-x, h, z], [x, h, z]],
            ),
            face(
                "wall",
                &wall,
                [[-x, 0., z], [-x, 0., -z], [-x, h, -z], [-x, h, z]],
            ),
            face(
                "wall",
                &wall,
                [[x, 0., -z], [x, 0., z], [x, h, z], [x, h, -z]],
            ),
        ]
    }

    /// Returns width × depth × height for notes.
    pub(crate) fn describe(&self) -> String {
        format!("{:.3} x {:.3} x {:.3}", self.width, self.depth, self.height)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ROOM: Room = Room {
        width: 3.0,
        depth: 4.0,
        height: 2.5,
    };

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn overlap_is_symmetric_and_agrees_with_a_shared_point(
            ax in -1.0f32..1.0, az in -1.0f32..1.0, ay in 0.0f32..6.3,
            bx in -1.0f32..1.0, bz in -1.0f32..1.0, by in 0.0f32..6.3,
        ) {
            let a = Footprint::new([ax, 0.0, az], ay, [0.4, 0.2], 1.0);
            let b = Footprint::new([bx, 0.2, bz], by, [0.3, 0.3], 1.0);
            prop_assert_eq!(a.overlaps(&b), b.overlaps(&a));
            let shared = (0..400).any(|k| {
                let (i, j) = ((k % 20) as f32 / 19.0 * 2.0 - 1.0, (k / 20) as f32 / 19.0 * 2.0 - 1.0);
                let x = ax + a.axes[0][0] * i * 0.399 + a.axes[1][0] * j * 0.199;
                let z = az + a.axes[0][1] * i * 0.399 + a.axes[1][1] * j * 0.199;
                b.contains(Vec3::new(x, 0.5, z), -0.001)
            });
            prop_assert!(!shared || a.overlaps(&b), "a shared point means overlap");
        }

        #[test]
        fn boxes_against_walls_stay_inside(k in 0usize..4, along in -1.0f32..1.0, w in 0.1f32..1.4, d in 0.1f32..0.9) {
            let (at, yaw) = ROOM.against_wall(k, along, [w, d], 0.01);
            let foot = Footprint::new([at[0], 0.0, at[1]], yaw, [w, d], 1.0);
            prop_assert!(ROOM.holds(&foot), "{:?}", foot);
        }
    }

    #[test]
    fn boxes_above_each_other_do_not_overlap() {
        let low = Footprint::new([0.0; 3], 0.3, [0.5; 2], 0.7);
        let high = Footprint::new([0.0, 0.7, 0.0], 1.0, [0.5; 2], 0.7);
        assert!(!low.overlaps(&high));
    }
}
