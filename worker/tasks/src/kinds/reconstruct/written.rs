//! Contents of a reconstruction's files: facts, errors against the true scene, and the density
//! field.

use std::collections::BTreeMap;

use bytes::Bytes;
use picofarm_dataset::{RenderArray, encode_render_group};
use picofarm_reconstruct::{
    Evidence, ReconstructError, Reconstructed, Surface, World,
    field::{PEAK, sigmoid, surface_logit},
    render::Renderer,
    score,
};
use picofarm_scene::Camera;
use picofarm_store::StorageError;
use serde_json::{Value, json};

/// Returns the facts about a reconstruction that do not depend on its true scene. They contain no
/// run times, so that equal measurements give equal bytes.
pub fn facts(made: &Reconstructed, mesh: &Surface) -> serde_json::Map<String, Value> {
    let left_out = made.measured.left_out.iter();
    let left_out: Vec<Value> = left_out
        .map(|l| json!({"beam": l.beam, "why": l.why}))
        .collect();
    let image = &made.measured.camera.intrinsics;
    let planes = made.planes.iter();
    let planes: Vec<Value> = planes
        .map(|p| json!({"normal": <[f32; 3]>::from(p.normal), "offset_m": p.offset}))
        .collect();
    let share =
        |of| made.evidence.iter().filter(|e| **e == of).count() as f64 / made.evidence.len() as f64;
    let facts = json!({
        "spots": made.measured.spots.len(),
        "image": [image.width, image.height],
        "left_out": left_out,
        "planes": planes,
        "iterations": made.iterations,
        "loss": made.loss,
        "held_out_loss": made.held_out_loss,
        "agreement": made.agreement,
        "vertices": mesh.positions.len(),
        "triangles": mesh.triangles.len(),
        "evidence": {
            "none": share(Evidence::None), "plane": share(Evidence::Plane),
            "paths": share(Evidence::Paths), "seen": share(Evidence::Seen),
        },
        "notes": made.notes,
    });
    match facts {
        Value::Object(facts) => facts,
        _ => unreachable!("written as an object"),
    }
}

/// Returns the errors of a reconstruction against its true scene: novel views, mesh, floating
/// matter.
///
/// # Errors
/// [`ReconstructError::Invalid`] if the scene has no surface in the grid.
pub fn errors(
    made: &Reconstructed,
    mesh: &Surface,
    world: &World,
    views: &[Camera],
    seed: u64,
) -> Result<serde_json::Map<String, Value>, ReconstructError> {
    let camera = &made.measured.camera;
    let novel = score::score_views(&Renderer::new(&made.field), camera, world, views);
    let of_mesh = match mesh.triangles.is_empty() {
        true => None,
        false => Some(score::mesh_score(mesh, world, &made.field, seed)?),
    };
    let floaters = score::floaters(&made.field, world, seed)?;
    let errors = json!({
        "depth": "distance along the ray at which half the light is stopped; where none is, to the grid's end",
        "novel_views": novel,
        "mesh": of_mesh,
        "floaters": floaters,
    });
    match errors {
        Value::Object(errors) => Ok(errors),
        _ => unreachable!("written as an object"),
    }
}

/// Encodes the density field as the objects of a Zarr group.
///
/// # Errors
/// Does not fail for a field produced by a reconstruction.
pub fn density(made: &Reconstructed) -> Result<BTreeMap<String, Bytes>, StorageError> {
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
        "surface_density_per_m": PEAK / field.spacing * sigmoid(surface_logit()),
        "surface": "where a ray at a right angle has lost half its light (T = 0.5); mesh.glb and mesh.ply are this level",
        "evidence": "what tells of a node: 0 nothing (its density is a guess), 1 a plane of the room, 2 light paths, 3 the camera",
    });
    let attributes = attributes.as_object().expect("written as an object");
    encode_render_group(
        &[array("density", &density), array("evidence", &evidence)],
        attributes,
    )
}
