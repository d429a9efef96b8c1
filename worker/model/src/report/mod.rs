//! What was trained, as one page that needs nothing beside it, and the same as JSON: figures beside trivial answers and
//! published ones, curves, pictures, speed against error, error against the number of scenes, lineage.
//!
//! Pure: a [`Report`] goes in, text comes out. The same report gives the same text.

mod chart;
mod colour;
mod curves;
mod image;
mod made;
mod maps;
mod page;
mod paper;
mod picture;
mod summary;
mod table;
#[cfg(test)]
mod tests;
mod ticks;
mod trade;
pub mod trials;

use picofarm_figures::{number, text};
use serde::{Deserialize, Serialize};

use crate::{Evaluated, Model, train::Line, train::Plan};

pub use page::html;
pub use paper::{Published, published, unlike};
pub use picture::{Picture, Plane, pictures};
pub use summary::{Group, Order, Scaling, Spread, Summary, json, summary};

/// What a page tells of.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Report {
    /// Its title.
    pub title: String,
    /// When it was made, as it shall stand there; empty = not said.
    pub date: String,
    /// Models, in the order in which they shall appear.
    pub models: Vec<Entry>,
}

/// A model, and what is known of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// How it was trained, and what it is asked.
    pub plan: Plan,
    /// What it learned from.
    pub data: Data,
    /// What else sets it apart, by name: where two-bounce times come from, precision. Models with the same plan but for
    /// the seed, the same data and the same conditions are one experiment.
    #[serde(default)]
    pub conditions: Vec<(String, String)>,
    /// Learned values.
    pub parameters: u64,
    /// Multiply-adds of a pass forward over one image, where they are known.
    #[serde(default)]
    pub multiply_adds: Option<f64>,
    /// A line for each epoch.
    #[serde(default)]
    pub history: Vec<Line>,
    /// Figures on scenes that it has not seen, where it was asked.
    #[serde(default)]
    pub evaluated: Option<Evaluated>,
    /// How fast it was trained, where that is known.
    #[serde(default)]
    pub speed: Option<Speed>,
    /// Where it comes from, by name: data version, code, worker, digests. A name stands for itself once.
    #[serde(default)]
    pub lineage: Vec<(String, String)>,
    /// Examples; [`pictures`] makes them.
    #[serde(default)]
    pub pictures: Vec<Picture>,
}

/// What a model learned from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    /// Name and version of the data set.
    pub name: String,
    /// Scenes to learn from, where their number is known.
    #[serde(default)]
    pub scenes: Option<u64>,
    /// Bounces in the measurement at most; 0 = all that there are, 2 = experiment A.4's.
    #[serde(default)]
    pub max_bounces: u32,
    /// Rows and columns of its images, and spots that light at once, where they are known.
    #[serde(default)]
    pub images: Option<[u32; 2]>,
    /// See [`Self::images`].
    #[serde(default)]
    pub spots: Option<u32>,
    /// Photon noise is in the measurement.
    #[serde(default)]
    pub noise: bool,
}

/// How fast a training was.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Speed {
    /// Training examples a second.
    pub samples_per_s: f64,
    /// Seconds of the whole training, where they are known.
    #[serde(default)]
    pub seconds: Option<f64>,
}

impl Entry {
    /// What a model says of itself; `side` is the number of rows and of columns of its images. The rest is for the caller
    /// to fill in.
    pub fn new(name: impl Into<String>, model: &Model, side: usize) -> Self {
        let plan = model.plan().clone();
        Self {
            name: name.into(),
            data: Data::default(),
            conditions: Vec::new(),
            parameters: model.learned() as u64,
            multiply_adds: Some(plan.net.multiply_adds(side)),
            history: Vec::new(),
            evaluated: None,
            speed: None,
            lineage: Vec::new(),
            pictures: Vec::new(),
            plan,
        }
    }
}
