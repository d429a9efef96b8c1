//! `picofarm model report`: writes a page about trained models.

use std::{fs, path::Path, time::SystemTime};

use picofarm_report::{Entry, Report, html, json};
use picofarm_results::Models;
use picofarm_tasks::{Control, report::Collector};
use serde_json::json;
use tokio::runtime::Handle;

use super::{nothing, open};
use crate::{
    commands::dataset::{failed, task_failed},
    error::{CliError, Code, Result, io},
    output::Output,
};

pub(super) async fn run(
    store: &str,
    names: &[String],
    (out, title): (&Path, String),
    pictures: usize,
    output: Output,
) -> Result<()> {
    let models = open(store)?;
    let mut entries = Vec::new();
    for name in chosen(store, &models, names).await? {
        output.say(format!("reads {name}"));
        entries.push(entry(store, &name, pictures).await?);
    }
    let date = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let report = Report {
        title,
        date: date[..10].to_owned(),
        models: entries,
    };
    let beside = out.with_extension("json");
    for (path, text) in [(out, html(&report)), (&beside, json(&report))] {
        fs::write(path, text).map_err(|e| io(path.display(), &e))?;
    }
    let facts = json!({"page": out, "json": beside, "models": report.models.len()});
    output.result(&facts, || {
        format!(
            "{} models: {} and {}",
            report.models.len(),
            out.display(),
            beside.display()
        )
    });
    Ok(())
}

/// Returns the selected finished models.
async fn chosen(store: &str, models: &Models, names: &[String]) -> Result<Vec<String>> {
    let mut there = Vec::new();
    for name in models.names().await.map_err(failed)? {
        if models.look(&name).await.map_err(failed)?.is_some() {
            there.push(name);
        }
    }
    let mut chosen: Vec<String> = Vec::new();
    for wanted in names {
        let begins = wanted.strip_suffix('*');
        let meant = |name: &&String| match begins {
            Some(begin) => name.starts_with(begin),
            None => *name == wanted,
        };
        let found: Vec<String> = there.iter().filter(meant).cloned().collect();
        if there.is_empty() {
            return Err(nothing(store));
        }
        if found.is_empty() {
            return Err(
                CliError::input(format!("no finished model is called {wanted:?}"))
                    .hint(format!("there are: {}", there.join(", "))),
            );
        }
        chosen.extend(found);
    }
    match (names.is_empty(), there.is_empty()) {
        (true, true) => Err(nothing(store)),
        (true, false) => Ok(there),
        (false, _) => {
            chosen.sort();
            chosen.dedup();
            Ok(chosen)
        }
    }
}

async fn entry(store: &str, name: &str, pictures: usize) -> Result<Entry> {
    let (collector, store, name) = (
        Collector::new(Handle::current()),
        store.to_owned(),
        name.to_owned(),
    );
    let collect = move || collector.entry(&store, &name, pictures, &Control::default());
    let collected = tokio::task::spawn_blocking(collect).await;
    collected
        .map_err(|e| CliError::new(Code::Failed, format!("drawing broke: {e}")))?
        .map_err(task_failed)
}
