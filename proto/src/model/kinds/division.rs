//! How the tasks of a stage that renders parts go over scenes.

/// Task `i` is part `i % tasks_per_scene` of scene `i / tasks_per_scene`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Division {
    /// Ranges of tiles of each scene.
    pub parts: u32,
}

impl Division {
    /// Tasks of each scene: the ranges of tiles, and the light paths that cross them.
    pub fn tasks_per_scene(self) -> u64 {
        u64::from(self.parts) + 1
    }

    /// The scene and the part that task `index` is.
    pub fn split(self, index: u64) -> (u64, u32) {
        let part = index % self.tasks_per_scene();
        (index / self.tasks_per_scene(), part as u32)
    }
}
