//! `demo --reconstruct`: reconstructs each rendered room.

use std::path::{Path, PathBuf};

use picofarm_proto::{
    show,
    spec::{
        OutputSettings, RenderTask, SourceSettings, StageSpec, TaskSpec,
        kinds::{ReconstructTask, reconstruct::ReconstructSettings},
    },
};
use picofarm_reconstruct::Settings as GridSettings;
use serde_json::{Value, json};

use crate::{
    client::jobfile,
    commands::dataset::reconstructions::{check, draw, opened},
    error::Result,
    output::{bytes, program},
    settings::Settings,
};

/// Nodes per side of the grids: two thirds of the default, for half its time.
const NODES: u32 = 128;
/// Number of novel views of each room to compare.
const VIEWS: u32 = 24;
/// Maximum number of rows of the contact sheet.
const ROWS: usize = 16;

/// Returns the announcement for the user.
pub fn announced() -> String {
    format!(
        "then each room in 3D: a grid of {NODES} nodes, from the depth and shadows of the ground truth. That is quick, and shows \
         what the method reaches at best; from histograms, in a job: from = \"captures\""
    )
}

/// Returns the stage that reconstructs the rooms rendered by `task`. It uses the ground truth,
/// because a demo has no networks and renders no separate histogram of each spot.
///
/// # Errors
/// Fails if a location cannot be used.
pub fn stage(task: &RenderTask, dir: &Path, settings: &Settings) -> Result<StageSpec> {
    let mut spec = TaskSpec::Reconstruct(ReconstructTask {
        source: SourceSettings {
            store: task.output.store.clone(),
            dataset: task.output.dataset.clone(),
        },
        count: task.scenes.count,
        reconstruct: ReconstructSettings {
            views: VIEWS,
            grid: GridSettings {
                nodes: NODES,
                ..GridSettings::default()
            },
            ..ReconstructSettings::default()
        },
        output: OutputSettings {
            dataset: reconstructions_of(&task.output.dataset),
            ..task.output.clone()
        },
    });
    jobfile::resolve_task(&mut spec, dir, &settings.assets)?;
    Ok(StageSpec::new(spec))
}

/// Returns the location of the reconstructions of a data set.
fn reconstructions_of(dataset: &str) -> String {
    format!("{dataset}-3d")
}

/// Verified reconstructions and their picture.
pub struct Rooms {
    place: String,
    sheet: PathBuf,
    scenes: u64,
    bytes: u64,
}

impl Rooms {
    /// Verifies the reconstructions of the data set at `place`, and draws them into `dir`.
    ///
    /// # Errors
    /// Exit code 6 naming the broken objects; fails if the folder cannot be written.
    pub async fn verify(place: &str, dir: &Path) -> Result<Self> {
        let place = reconstructions_of(place);
        let there = opened(&place).await?;
        let report = check(&place, &there).await?;
        let sheet = dir.join("reconstructions.png");
        draw(&place, &there, ROWS, &sheet).await?;
        Ok(Self {
            place,
            sheet,
            scenes: report.scenes,
            bytes: report.bytes,
        })
    }

    /// Returns the facts for JSON.
    pub fn facts(&self) -> Value {
        json!({"folder": self.place, "scenes": self.scenes, "bytes": self.bytes, "contact_sheet": self.sheet})
    }

    /// Describes where the reconstructions are.
    pub fn summary(&self) -> String {
        format!(
            "rooms in 3D      {} ({}, all verified): scenes/<scene>/ with mesh.glb, views.png, metrics.json\n\
             novel views      {}\n",
            show::line(&self.place),
            bytes(self.bytes),
            self.sheet.display(),
        )
    }

    /// Returns suggestions for next commands.
    pub fn next(&self) -> String {
        let place = show::argument(&self.place);
        let program = program();
        format!("{program} dataset info {place}\n  {program} dataset report {place}\n  ")
    }
}
