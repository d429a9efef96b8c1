//! A report on trained models as one self-contained page, and as JSON: metrics compared with
//! trivial answers and published ones, curves, pictures, speed against error, error against the
//! number of scenes, lineage.
//!
//! Reports are pure functions: the same [`Report`] gives the same text.

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

use picofarm_model::{
    Evaluated, Model,
    train::{Line, Plan},
};

pub use page::html;
pub use paper::{Published, published, unlike};
pub use picture::{Picture, Plane, pictures};
pub use summary::{Group, Order, Scaling, Spread, Summary, json, summary};

/// The version of pages and JSON. It is part of the key of a report.
pub const VERSION: &str = "report-2";

/// The contents of a report.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Report {
    /// The title.
    pub title: String,
    /// The date of the report, in the form to be shown; empty = none.
    pub date: String,
    /// The models, in the order in which they appear.
    pub models: Vec<Entry>,
}

/// A model and its properties.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// The model's name.
    pub name: String,
    /// The plan by which it was trained.
    pub plan: Plan,
    /// The training data.
    pub data: Data,
    /// Other distinguishing conditions, by name: the source of two-bounce times, precision. Models
    /// with the same plan except for the seed, the same data and the same conditions are one
    /// experiment.
    #[serde(default)]
    pub conditions: Vec<(String, String)>,
    /// The number of learned values.
    pub parameters: u64,
    /// The multiply-adds of a forward pass over one image, if known.
    #[serde(default)]
    pub multiply_adds: Option<f64>,
    /// A line for each epoch.
    #[serde(default)]
    pub history: Vec<Line>,
    /// The metrics on unseen scenes, if it was evaluated.
    #[serde(default)]
    pub evaluated: Option<Evaluated>,
    /// The training speed, if known.
    #[serde(default)]
    pub speed: Option<Speed>,
    /// The model's origin, by name: data version, code, worker, digests. Each name occurs once.
    #[serde(default)]
    pub lineage: Vec<(String, String)>,
    /// Example pictures, which [`pictures`] creates.
    #[serde(default)]
    pub pictures: Vec<Picture>,
}

/// The training data of a model.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    /// The name and version of the data set.
    pub name: String,
    /// The number of training scenes, if known.
    #[serde(default)]
    pub scenes: Option<u64>,
    /// The greatest number of bounces in the measurement; 0 = unlimited, 2 = experiment A.4's.
    #[serde(default)]
    pub max_bounces: u32,
    /// The rows and columns of its images, if known.
    #[serde(default)]
    pub images: Option<[u32; 2]>,
    /// The number of spots that are lit at once, if known.
    #[serde(default)]
    pub spots: Option<u32>,
    /// Whether the measurement contains photon noise.
    #[serde(default)]
    pub noise: bool,
}

/// The speed of a training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Speed {
    /// Training examples per second.
    pub samples_per_s: f64,
    /// The seconds of the whole training, if known.
    #[serde(default)]
    pub seconds: Option<f64>,
}

impl Entry {
    /// Creates an entry from a model; `side` is the number of rows and of columns of its images.
    /// The caller sets the other fields.
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
