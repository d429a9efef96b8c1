//! `picofarm dataset snapshot …`: permanent records of a data set's contents.

use std::time::SystemTime;

use picofarm_dataset::{Dataset, Snapshot};
use serde_json::json;

use super::{
    failed,
    late::Late,
    open,
    verify::{How, look, tell},
};
use crate::{
    args::Snapshot as Command,
    error::Result,
    output::{Output, bytes, table},
};

/// Maximum number of differing scenes shown as text.
const SHOWN: usize = 20;

pub async fn run(command: Command, output: Output) -> Result<()> {
    match command {
        Command::Create { dataset, name } => create(&dataset, name, output).await,
        Command::List { dataset } => list(&dataset, output).await,
        Command::Show { dataset, name } => show(&dataset, &name, output).await,
        Command::Verify {
            dataset,
            name,
            fast,
        } => {
            let opened = open(&dataset).await?;
            let snapshot = opened.snapshot(&name).await.map_err(failed)?;
            let how = How {
                fast,
                complete: false,
                snapshot: Some(&snapshot),
            };
            let report = look(&opened, &how, output).await?;
            tell(&dataset, &how, &report, output)
        }
        Command::Diff { dataset, from, to } => diff(&dataset, &from, to.as_deref(), output).await,
    }
}

async fn create(place: &str, name: String, output: Output) -> Result<()> {
    let dataset = open(place).await?;
    let now = humantime::format_rfc3339_seconds(SystemTime::now());
    let snapshot = present(&dataset, output).await?;
    let snapshot = snapshot.named(name, now.to_string());
    let size = dataset.create_snapshot(&snapshot).await.map_err(failed)?;
    let file = dataset.snapshot_place(&snapshot.name);
    let facts = json!({
        "dataset": place, "name": snapshot.name, "scenes": snapshot.len(), "bytes": snapshot.bytes,
        "id": snapshot.id(), "file": file, "size": size, "changed": size.is_some(),
    });
    output.result(&facts, || {
        let what = match size {
            Some(size) => format!("{file}: {}", bytes(size)),
            None => format!("{file}: there already, with the same scenes"),
        };
        format!(
            "{what}\n{} scenes, {}; id {}",
            snapshot.len(),
            bytes(snapshot.bytes),
            snapshot.id()
        )
    });
    Ok(())
}

async fn present(dataset: &Dataset, output: Output) -> Result<Snapshot> {
    let late = Late::new("manifests read", output);
    let watch = |done, of| late.update(done, of);
    let snapshot = dataset.present(&watch).await.map_err(failed);
    late.finish();
    snapshot
}

async fn list(place: &str, output: Output) -> Result<()> {
    let dataset = open(place).await?;
    let mut all = Vec::new();
    for name in dataset.snapshots().await.map_err(failed)? {
        all.push((dataset.snapshot(&name).await, name));
    }
    let facts: Vec<_> = all
        .iter()
        .map(|(snapshot, name)| match snapshot {
            Ok(s) => json!({
                "name": name, "created": s.created, "scenes": s.len(), "bytes": s.bytes, "id": s.id(),
            }),
            Err(error) => json!({"name": name, "damaged": error.to_string()}),
        })
        .collect();
    output.result(&facts, || {
        if all.is_empty() {
            return format!("{place}: no snapshots");
        }
        let head = ["name", "created", "scenes", "bytes", "id"];
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        rows.extend(all.iter().map(|(snapshot, name)| match snapshot {
            Ok(s) => vec![
                name.clone(),
                s.created.clone(),
                s.len().to_string(),
                bytes(s.bytes),
                s.id(),
            ],
            Err(error) => vec![name.clone(), format!("damaged: {error}")],
        }));
        table(&rows)
    });
    Ok(())
}

async fn show(place: &str, name: &str, output: Output) -> Result<()> {
    let dataset = open(place).await?;
    let snapshot = dataset.snapshot(name).await.map_err(failed)?;
    let scenes: Vec<_> = snapshot
        .scenes()
        .map(|scene| json!([scene, snapshot.manifest_sha256(scene)]))
        .collect();
    let facts = json!({
        "dataset": place, "name": snapshot.name, "created": snapshot.created, "scenes": snapshot.len(),
        "bytes": snapshot.bytes, "id": snapshot.id(), "spec": snapshot.spec,
        "file": dataset.snapshot_place(name), "manifests": scenes,
    });
    output.result(&facts, || {
        let (first, last) = (snapshot.scenes().next(), snapshot.scenes().last());
        let range = match (first, last) {
            (Some(first), Some(last)) => format!(" ({first} to {last})"),
            _ => String::new(),
        };
        format!(
            "{}: made {}\n{} of {} scenes{range}, {}\nid {}",
            dataset.snapshot_place(name),
            snapshot.created,
            snapshot.len(),
            snapshot.spec.scenes,
            bytes(snapshot.bytes),
            snapshot.id()
        )
    });
    Ok(())
}

async fn diff(place: &str, from: &str, to: Option<&str>, output: Output) -> Result<()> {
    let dataset = open(place).await?;
    let first = dataset.snapshot(from).await.map_err(failed)?;
    let second = match to {
        Some(name) => dataset.snapshot(name).await.map_err(failed)?,
        None => present(&dataset, output).await?,
    };
    let found = first.difference(&second);
    let facts = json!({
        "dataset": place, "from": from, "to": to, "added": found.added, "removed": found.removed,
        "changed": found.changed, "same": found.same,
    });
    output.result(&facts, || {
        let line = |what: &str, scenes: &[u64]| {
            let mut names: Vec<String> =
                scenes.iter().take(SHOWN).map(ToString::to_string).collect();
            if scenes.len() > SHOWN {
                names.push("…".into());
            }
            let names = names.join(", ");
            vec![what.to_owned(), scenes.len().to_string(), names]
        };
        let same = vec!["same".to_owned(), found.same.to_string(), String::new()];
        let rows = [
            line("added", &found.added),
            line("removed", &found.removed),
            line("changed", &found.changed),
            same,
        ];
        format!(
            "{place}: from {from} to {}\n{}",
            to.unwrap_or("now"),
            table(&rows)
        )
    });
    Ok(())
}
