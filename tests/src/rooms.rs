//! Stages of small primitive rooms, for job files with several stages.

use std::path::Path;

/// Primitive rooms with four spots that one stage renders in a moment.
#[derive(Debug, Clone)]
pub struct Rooms {
    /// Name of the stage and of its data set.
    pub name: String,
    /// Number of scenes.
    pub count: u64,
    /// Seed.
    pub seed: u64,
    /// Fields of `render`, as TOML.
    pub render: String,
}

impl Rooms {
    /// Rooms with 16×16 pixels × 32 bins, enough for networks of three levels.
    pub fn small(count: u64) -> Self {
        Self {
            name: "rooms".into(),
            count,
            seed: 3,
            render: "resolution = 16, samples = 2, bins = 32, bin_width_m = 0.768".into(),
        }
    }

    /// Rooms with 32×32 pixels × 200 bins, enough for reconstructions.
    pub fn fine(count: u64) -> Self {
        Self {
            seed: 8,
            render: "resolution = 32, samples = 2, bins = 200, bin_width_m = 0.0768".into(),
            ..Self::small(count)
        }
    }

    /// Adds a histogram for each spot.
    pub fn per_spot(mut self) -> Self {
        self.render += ", per_spot = true";
        self
    }

    /// Returns the stage, to be written into a job file.
    pub fn stage(&self, store: &Path) -> String {
        let Self {
            name,
            count,
            seed,
            render,
        } = self;
        format!(
            "[[stage]]\nname = {name:?}\n\
             scenes = {{ kind = \"primitive\", count = {count}, seed = {seed}, spots = 4 }}\n\
             render = {{ {render} }}\n\
             output = {{ store = {store:?}, dataset = {name:?} }}\n"
        )
    }

    /// Returns the stage, and one that splits its scenes into these numbers for training,
    /// validation and test.
    pub fn split_stages(&self, store: &Path, counts: [u64; 3]) -> String {
        let rooms = self.stage(store);
        let name = &self.name;
        format!(
            "{rooms}[[stage]]\nkind = \"split\"\nsource = {name:?}\nsplit = {{ counts = {counts:?} }}\n"
        )
    }
}
