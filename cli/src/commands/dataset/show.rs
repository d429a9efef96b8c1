//! `picofarm dataset show`: shows the origin of a scene.

use picofarm_store::published::Manifest as _;
use picofarm_tasks::repair::leads_to;
use serde_json::{Value, json};

use super::{failed, open, predictions};
use crate::{
    args::DatasetShow,
    error::Result,
    output::{Output, bytes, table},
};

pub async fn run(args: &DatasetShow, output: Output) -> Result<()> {
    if let Some(there) = predictions::find(&args.dataset).await? {
        return predictions::show(args, &there, output).await;
    }
    let dataset = open(&args.dataset).await?;
    let manifest = dataset.manifest(args.scene).await.map_err(failed)?;
    let made = &manifest.provenance;
    let recipe = recipe(&dataset, args.scene, &made.task_key).await?;
    let mut snapshots = Vec::new();
    for name in dataset.snapshots().await.map_err(failed)? {
        match dataset.snapshot(&name).await {
            Ok(s) if s.manifest_sha256(args.scene) == Some(sha256(&manifest.to_bytes())) => {
                snapshots.push(name);
            }
            Ok(_) => {}
            Err(error) => output.warn(format!("warning: snapshot {name} is left out: {error}")),
        }
    }
    let kind = made.plan["kind"].as_str().unwrap_or("render");
    let facts = json!({
        "dataset": args.dataset, "scene": args.scene, "kind": kind, "task_key": made.task_key,
        "code": made.renderer, "encoder": manifest.encoder, "seed": made.seed,
        "manifest_sha256": sha256(&manifest.to_bytes()), "bytes": manifest.total_bytes(), "scale": manifest.scale,
        "coding_error": manifest.error, "parent": made.plan["source"], "files": made.plan["files"],
        "recipe": recipe.as_ref().map(|(place, stage)| json!({"place": place, "stage": stage})),
        "snapshots": snapshots, "plan": made.plan, "objects": manifest.objects,
    });
    output.result(&facts, || {
        let mut rows = vec![
            row("scene", &json!(args.scene)),
            row("made by", &json!(kind)),
            row("task key", &json!(made.task_key)),
            row("code", &json!(made.renderer)),
            row("encoder", &json!(manifest.encoder)),
            row("seed", &json!(made.seed)),
            row(
                "manifest",
                &json!(format!("SHA-256 {}", sha256(&manifest.to_bytes()))),
            ),
            row(
                "objects",
                &json!(format!(
                    "{}, {}",
                    manifest.objects.len(),
                    bytes(manifest.total_bytes())
                )),
            ),
        ];
        if let Some(source) = made.plan["source"].as_object() {
            rows.extend(
                source
                    .iter()
                    .map(|(name, value)| row(&format!("parent {name}"), value)),
            );
        }
        for file in made.plan["files"].as_array().into_iter().flatten() {
            let text = format!(
                "{} (SHA-256 {})",
                text(&file["name"]),
                text(&file["sha256"])
            );
            rows.push(row("file", &json!(text)));
        }
        if let Some(scene) = made.plan["scene"].as_object() {
            rows.extend(
                scene
                    .iter()
                    .map(|(name, value)| row(&format!("scene {name}"), value)),
            );
        }
        match &recipe {
            Some((place, stage)) => {
                rows.push(row("recipe", &json!(place)));
                for part in ["scenes", "source", "render", "reprocess"] {
                    if !stage[part].is_null() {
                        rows.push(row(part, &stage[part]));
                    }
                }
            }
            None => rows.push(row("recipe", &json!("none in the data set"))),
        }
        if !snapshots.is_empty() {
            rows.push(row("snapshots", &json!(snapshots.join(", "))));
        }
        table(&rows)
    });
    Ok(())
}

/// Returns the location and the stage of the recipe from which the scene's task key follows.
/// Returns `None` if several recipes are possible.
async fn recipe(
    dataset: &picofarm_dataset::Dataset,
    scene: u64,
    task_key: &str,
) -> Result<Option<(String, Value)>> {
    let mut found = Vec::new();
    for key in dataset.recipe_keys().await.map_err(failed)? {
        if let Some(recipe) = dataset.recipe(&key, scene).await.map_err(failed)? {
            let stage = recipe.content["stage"].clone();
            if leads_to(&recipe, scene, task_key) || stage["kind"] == "reprocess" {
                found.push((recipe.place, stage));
            }
        }
    }
    Ok(match found.len() {
        1 => found.pop(),
        _ => None,
    })
}

fn row(name: &str, value: &Value) -> Vec<String> {
    vec![name.to_owned(), text(value)]
}

fn text(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

/// SHA-256, in hexadecimal.
fn sha256(bytes: &[u8]) -> String {
    picofarm_store::sha256_hex(bytes)
}
