//! Small jobs as TOML files.

use std::{
    fmt::Write,
    path::{Path, PathBuf},
};

/// A job that renders in seconds; the fields are those of the job file.
#[derive(Clone)]
pub struct Job {
    /// Name.
    pub name: String,
    /// `kind = …` and what goes with it.
    pub scenes: String,
    /// Scenes; not written for `kind = "files"`.
    pub count: Option<u64>,
    /// Seed.
    pub seed: u64,
    /// Pixels.
    pub resolution: u32,
    /// Camera paths a pixel: what a scene costs.
    pub samples: u32,
    /// ℓ_min in metres.
    pub gate_start_m: f64,
    /// Store.
    pub store: PathBuf,
    /// Data set.
    pub dataset: String,
    /// Failures until a task is dead.
    pub max_failures: u32,
    /// Lost workers until a task is dead.
    pub max_crashes: u32,
}

impl Job {
    /// Primitive rooms of 16×16 pixels × 64 bins, done in a moment each.
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

    /// The same with so many paths that each scene takes one to two seconds on one thread: long enough to be struck
    /// in the middle. Lost workers never use up a task.
    pub fn slow(store: &Path, count: u64) -> Self {
        Self {
            name: "slow".into(),
            samples: SLOW,
            max_crashes: 1000,
            ..Self::quick(store, count)
        }
    }

    /// Scene files, one task each.
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

    /// Where the data set lies.
    pub fn place(&self) -> PathBuf {
        self.store.join(&self.dataset)
    }

    /// The job file's text.
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
    /// When it cannot be written.
    pub fn write(&self, file: &Path) {
        std::fs::write(file, self.toml()).expect("the test's folder is writable");
    }
}

/// Paths a pixel for one to two seconds a scene.
const SLOW: u32 = 768;
