//! The files of a reconstruction, all or none: they are written beside the folder and renamed into place.

use std::{fs, path::Path};

use picofarm_dataset::{RenderArray, write_render_group};
use picofarm_reconstruct::{Reconstructed, Surface, field::surface_logit};
use serde_json::{Value, json};

use crate::error::{CliError, Code, Result, io};

/// Writes mesh, density and metrics to `out`, which does not exist or is empty.
///
/// # Errors
/// The folder cannot be written.
pub fn write(out: &Path, made: &Reconstructed, mesh: &Surface, metrics: &Value) -> Result<()> {
    let out = std::path::absolute(out).map_err(|e| io(format!("--out {}", out.display()), &e))?;
    let (Some(parent), Some(name)) = (out.parent(), out.file_name()) else {
        return Err(CliError::input(format!(
            "--out {}: expected a new folder",
            out.display()
        )));
    };
    let told = |e: std::io::Error| io(format!("--out {}", out.display()), &e);
    fs::create_dir_all(parent).map_err(told)?;
    let partial = parent.join(format!(
        ".{}.partial-{}",
        name.display(),
        uuid::Uuid::new_v4()
    ));
    let written = into(&partial, made, mesh, metrics)
        // Replaces an empty folder; fails on one that was filled meanwhile.
        .and_then(|()| fs::rename(&partial, &out).map_err(told));
    if written.is_err() {
        // The first error is the one to tell; what cannot be removed shows in the folder.
        let _ = fs::remove_dir_all(&partial);
    }
    written
}

fn into(dir: &Path, made: &Reconstructed, mesh: &Surface, metrics: &Value) -> Result<()> {
    let save = |name: &str, bytes: &[u8]| {
        let path = dir.join(name);
        fs::write(&path, bytes).map_err(|e| io(path.display(), &e))
    };
    fs::create_dir_all(dir).map_err(|e| io(dir.display(), &e))?;
    density(&dir.join("density.zarr"), made)?;
    save("mesh.ply", &mesh.ply())?;
    let text = serde_json::to_string_pretty(metrics).expect("metrics are plain data");
    save("metrics.json", (text + "\n").as_bytes())
}

fn density(path: &Path, made: &Reconstructed) -> Result<()> {
    let field = &made.field;
    let [nx, ny, nz] = field.nodes.map(|n| n as u64);
    let density: Vec<f32> = (0..field.logit.len()).map(|i| field.density(i)).collect();
    let evidence: Vec<f32> = made.evidence.iter().map(|e| f32::from(*e as u8)).collect();
    let shape = [nz, ny, nx];
    let array = |name, data| RenderArray {
        name,
        shape: &shape,
        dimension_names: &["z", "y", "x"],
        data,
    };
    let attributes = json!({
        "origin_m": <[f32; 3]>::from(field.origin),
        "spacing_m": field.spacing,
        "axes": "x, y, z of the scene, metres; node (k, j, i) lies at origin + spacing * (i, j, k)",
        "density": "1/m at the nodes: 4/spacing * sigmoid(logit); between nodes the logit is trilinear, logit = ln(s/(1 - s)) with s = density * spacing/4",
        "surface_density_per_m": picofarm_reconstruct::field::PEAK / field.spacing
            * picofarm_reconstruct::field::sigmoid(surface_logit()),
        "surface": "where a ray at a right angle has lost half its light (T = 0.5); mesh.ply is this level",
        "evidence": "what tells of a node: 0 nothing (its density is a guess), 1 a plane of the room, 2 light paths, 3 the camera",
    });
    let attributes = attributes.as_object().expect("written as an object");
    write_render_group(
        path,
        &[array("density", &density), array("evidence", &evidence)],
        attributes,
    )
    .map_err(|e| CliError::new(Code::Resource, e))
}
