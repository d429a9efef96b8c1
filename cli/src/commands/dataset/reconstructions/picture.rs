//! `dataset picture` of reconstructions: a contact sheet with one novel view per scene.

use std::path::Path;

use picofarm_figures::{Canvas, TEXT};
use picofarm_results::Reconstructions;
use picofarm_store::StorageError;
use picofarm_tasks::reconstruct::{CELL, STEP, columns, first_row};

use super::{figure, metrics};
use crate::{
    commands::dataset::failed,
    error::{CliError, Code, Result},
    output::files::save,
};

/// Width of the column for a scene's number and error, in pixels.
const SIDE: usize = 72;
const GAP: usize = 4;
const HEAD: usize = TEXT + 8;
const BACKGROUND: [u8; 3] = [16, 16, 20];
const INK: [u8; 3] = [210, 210, 215];

/// Draws the first `rows` scenes as a PNG.
///
/// # Errors
/// Fails if there are no scenes, a scene has no novel views or is damaged, or the file cannot be
/// written.
pub async fn draw(place: &str, there: &Reconstructions, rows: usize, path: &Path) -> Result<()> {
    let present = there.scenes_present().await.map_err(failed)?;
    let scenes = &present[..present.len().min(rows.max(1))];
    if scenes.is_empty() {
        return Err(CliError::input(format!(
            "{place}: no finished scene to draw"
        )));
    }
    let titles = columns();
    let size = (
        SIDE + titles.len() * STEP,
        HEAD + scenes.len() * (CELL + GAP),
    );
    let mut canvas = Canvas::new(size.0, size.1, BACKGROUND);
    for (k, title) in titles.iter().enumerate() {
        canvas.text(SIDE + k * STEP, 4, title, INK);
    }
    for (row, &scene) in scenes.iter().enumerate() {
        let y = HEAD + row * (CELL + GAP);
        let drawn = views(place, there, scene).await?;
        match first_row(&drawn) {
            Some(shown) => canvas.paste((SIDE, y), &shown),
            None => canvas.text(SIDE, y + CELL / 2, "no view stands in the open", INK),
        }
        canvas.text(4, y + CELL / 2 - TEXT, &scene.to_string(), INK);
        if let Some(l1) = figure(
            &metrics(place, there, scene).await?,
            "/novel_views/all/l1_m",
        ) {
            canvas.text(4, y + CELL / 2 + TEXT, &format!("{l1:.4} m"), INK);
        }
    }
    save(&canvas, path)
}

/// Reads the picture of a scene's novel views.
async fn views(place: &str, there: &Reconstructions, scene: u64) -> Result<Canvas> {
    let bytes = there.read(scene, "views.png").await.map_err(|e| match e {
        StorageError::NotPublished { .. } => CliError::input(format!(
            "{place}: scene {scene} has no views.png: its stage had views = 0"
        ))
        .hint("make the reconstructions again in another folder with views = 24 in their stage"),
        e => failed(e),
    })?;
    Canvas::from_png(&bytes).map_err(|what| {
        let what = format!("{place}: scenes/{scene}/views.png {what}");
        CliError::new(Code::Damaged, what)
    })
}
