//! Small jobs as TOML files.

use std::{
    fmt::Write,
    path::{Path, PathBuf},
};

/// A job that renders in seconds. The fields are those of the job file.
#[derive(Clone)]
pub struct Job {
    /// Name.
    pub name: String,
    /// `kind = …` and its parameters.
    pub scenes: String,
    /// Number of scenes; not written for `kind = "files"`.
    pub count: Option<u64>,
    /// Seed.
    pub seed: u64,
    /// Width and height of the image, in pixels.
    pub resolution: u32,
    /// Camera paths per pixel, which determine the time per scene.
    pub samples: u32,
    /// ℓ_min in metres.
    pub gate_start_m: f64,
    /// Store.
    pub store: PathBuf,
    /// Data set.
    pub dataset: String,
    /// Number of failures after which a task is dead.
    pub max_failures: u32,
    /// Number of lost workers after which a task is dead.
    pub max_crashes: u32,
}

impl Job {
    /// A job of primitive rooms with 16×16 pixels × 64 bins, each rendered in a moment.
    pub fn quick(store: &Path, count: u64) -> Self {
        Self {
            name: "quick".into(),
            scenes: "kind = \"primitive\"\nspots = 4".into(),
            count: Some(count),
            seed: 11,
            resolution: 16,
            samples: 4,
            gate_start_m: 1.0,
            store: store.to_owned(),
            dataset: "rooms".into(),
            max_failures: 3,
            max_crashes: 3,
        }
    }

    /// A job of slow scenes: each takes one to two seconds on one thread, long enough to be
    /// interrupted. Lost workers never make a task dead.
    pub fn slow(store: &Path, count: u64) -> Self {
        Self {
            name: "slow".into(),
            samples: SLOW,
            max_crashes: 1000,
            ..Self::quick(store, count)
        }
    }

    /// A job of scene files, one task each.
    pub fn files(store: &Path, files: &[&Path]) -> Self {
        let list: Vec<String> = files
            .iter()
            .map(|f| format!("{:?}", f.display().to_string()))
            .collect();
        Self {
            name: "files".into(),
            scenes: format!("kind = \"files\"\nfiles = [{}]\nspots = 4", list.join(", ")),
            count: None,
            ..Self::quick(store, 1)
        }
    }

    /// Returns the location of the data set.
    pub fn place(&self) -> PathBuf {
        self.store.join(&self.dataset)
    }

    /// Returns the job file's text.
    pub fn toml(&self) -> String {
        let mut text = format!(
            "name = {:?}\n\n[scenes]\n{}\nseed = {}\n",
            self.name, self.scenes, self.seed
        );
        if let Some(count) = self.count {
            writeln!(text, "count = {count}").expect("writing to a string");
        }
        text + &format!(
            "\n[render]\nresolution = {}\nsamples = {}\ngate_start_m = {:?}\nbin_width_m = 0.384\nbins = 64\n\n\
             [output]\nstore = {:?}\ndataset = {:?}\n\n\
             [limits]\nmax_failures = {}\nmax_crashes = {}\n",
            self.resolution,
            self.samples,
            self.gate_start_m,
            self.store.display().to_string(),
            self.dataset,
            self.max_failures,
            self.max_crashes
        )
    }

    /// Writes the job file.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write(&self, file: &Path) {
        std::fs::write(file, self.toml()).expect("the test's folder is writable");
    }
}

/// Paths per pixel for one to two seconds per scene.
const SLOW: u32 = 768;
