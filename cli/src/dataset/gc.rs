//! `picofarm dataset gc`: lists or deletes objects that belong to no finished scene.

use picofarm_dataset::{Collection, MIN_GRACE};
use picofarm_results::collect_garbage;
use serde_json::{Value, json};

use super::{failed, open};
use crate::{
    args::DatasetGc,
    error::{CliError, Result},
    output::{Output, bytes},
};

pub async fn run(args: &DatasetGc, output: Output) -> Result<()> {
    let (grace, delete) = (args.older_than, args.delete && !args.dry_run);
    if grace < MIN_GRACE && !args.nothing_runs {
        return Err(CliError::input(format!(
            "--older-than: expected at least 1h, found {} s: a worker that is writing a scene now would lose \
             its objects",
            grace.as_secs()
        ))
        .hint("give a longer age, or --nothing-runs if no worker runs on this data set"));
    }
    let opened = open(&args.dataset).await?;
    let found = collect_garbage(&opened, grace, delete)
        .await
        .map_err(failed)?;
    output.result(&collection_json(&args.dataset, &found, delete), || {
        collected(&args.dataset, &found, delete)
    });
    Ok(())
}

fn collection_json(place: &str, found: &Collection, delete: bool) -> Value {
    let objects: Vec<_> = found
        .orphans
        .iter()
        .map(|o| json!({"object": o.object, "bytes": o.bytes, "scene": o.scene, "why": o.why()}))
        .collect();
    json!({
        "dataset": place, "deleted": delete, "objects": found.orphans.len(), "bytes": found.bytes(),
        "orphans": objects, "young": found.young, "published": found.published,
        "pinned": found.pinned,
    })
}

fn collected(place: &str, found: &Collection, delete: bool) -> String {
    let mut text: String = found
        .orphans
        .iter()
        .map(|o| format!("{}  {}  {}\n", o.object, bytes(o.bytes), o.why()))
        .collect();
    text += &format!(
        "{place}: {} object(s), {} that belong to no finished scene{}",
        found.orphans.len(),
        bytes(found.bytes()),
        match (delete, found.orphans.is_empty()) {
            (_, true) => "",
            (true, false) => ", deleted",
            (false, false) => "; --delete deletes them",
        }
    );
    if found.young > 0 {
        text += &format!(
            "\n{} younger object(s) of unfinished scenes were spared",
            found.young
        );
    }
    if found.published > 0 {
        text += &format!(
            "\n{} object(s) were spared: their scenes are finished by now",
            found.published
        );
    }
    if found.pinned > 0 {
        text += &format!(
            "\n{} object(s) were spared: a snapshot names their scenes, whose manifests were lost (dataset repair --snapshot \
             puts them back)",
            found.pinned
        );
    }
    text
}
