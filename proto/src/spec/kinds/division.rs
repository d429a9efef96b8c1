//! The division of scenes into the tasks of a part stage.

/// Task `i` is part `i % tasks_per_scene` of scene `i / tasks_per_scene`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Division {
    /// Ranges of tiles of each scene.
    pub parts: u32,
}

impl Division {
    /// Returns the tasks of each scene: the ranges of tiles, and one for the light paths that cross
    /// them.
    pub fn tasks_per_scene(self) -> u64 {
        u64::from(self.parts) + 1
    }

    /// Returns the scene and the part of task `index`.
    pub fn split(self, index: u64) -> (u64, u32) {
        let part = index % self.tasks_per_scene();
        (index / self.tasks_per_scene(), part as u32)
    }
}
