//! `picofarm model …`: the models of a store.

mod care;
#[cfg(feature = "networks")]
mod devices;
#[cfg(feature = "networks")]
mod import;
#[cfg(feature = "networks")]
mod report;

use std::{
    io::{ErrorKind, Write},
    path::Path,
};

use picofarm_proto::{
    show,
    spec::kinds::{Declared as _, PythonTask},
};
use picofarm_results::{Checkpoint, Evaluation, ModelManifest, Models, Verdict};
use picofarm_store::open_store;
use picofarm_store::published::Manifest as _;
use serde_json::{Value, json};

#[cfg(not(feature = "networks"))]
use crate::error::not_built;
use crate::{
    args::Model as Command,
    commands::dataset::failed,
    error::{CliError, Result, io},
    output::{Output, bytes, table},
};

/// Name of the object with a model's weights.
pub(crate) const WEIGHTS: &str = "weights.safetensors";

pub async fn run(command: Command, output: Output) -> Result<()> {
    match command {
        Command::List { store } => list(&store, output).await,
        #[cfg(not(feature = "networks"))]
        Command::Devices => Err(not_built("networks", "graphics processors")),
        #[cfg(feature = "networks")]
        Command::Devices => devices::run(output),
        Command::Show { store, name } => show(&store, &name, output).await,
        Command::Export { store, name, out } => {
            let out = out.unwrap_or_else(|| format!("{name}.safetensors").into());
            export(&store, &name, &out, output).await
        }
        #[cfg(not(feature = "networks"))]
        Command::Import { .. } => Err(not_built("networks", "imports of models")),
        #[cfg(feature = "networks")]
        Command::Import {
            store,
            name,
            file,
            dataset,
            settings,
        } => import::run(&store, &name, (&file, &settings), &dataset, output).await,
        Command::Verify { store, names } => care::verify(&store, &names, output).await,
        Command::Repair {
            store,
            name,
            dry_run,
        } => care::repair(&store, &name, dry_run, output).await,
        Command::Remove {
            store,
            name,
            force,
            dry_run,
        } => care::remove(&store, &name, (force, dry_run), output).await,
        #[cfg(not(feature = "networks"))]
        Command::Report { .. } => Err(not_built("networks", "reports of models")),
        #[cfg(feature = "networks")]
        Command::Report {
            store,
            names,
            out,
            title,
            pictures,
        } => report::run(&store, &names, (&out, title), pictures, output).await,
    }
}

pub(crate) fn open(store: &str) -> Result<Models> {
    let (store, prefix) = open_store(store).map_err(failed)?;
    Ok(Models::new(store, &prefix))
}

async fn list(store: &str, output: Output) -> Result<()> {
    let models = open(store)?;
    let mut found = Vec::new();
    for name in models.names().await.map_err(failed)? {
        let manifest = models.look(&name).await.map_err(failed)?;
        let checkpoints = models.checkpoints(&name).await.map_err(failed)?;
        // A folder may contain only evaluations, notes, or objects of a killed training.
        if manifest.is_some() || !checkpoints.is_empty() {
            let verdict = match &manifest {
                Some(manifest) => Some(verdict(&models, manifest).await?),
                None => None,
            };
            let manifest = manifest.zip(verdict);
            found.push((name, manifest, furthest(&checkpoints)));
        }
    }
    if found.is_empty() {
        return Err(nothing(store));
    }
    let document: Vec<Value> = found
        .iter()
        .map(|(name, manifest, step)| match manifest {
            Some((m, verdict)) => json!({"name": name, "finished": true, "kind": m.kind, "metrics": m.metrics,
                              "dataset": m.lineage.dataset, "bytes": m.total_bytes(), "code": m.lineage.code,
                              "verdict": verdict}),
            None => json!({"name": name, "finished": false, "step": step}),
        })
        .collect();
    output.result(&document, || {
        let header = ["name", "predicts", "trained on", "size", "figures"];
        let header = header.map(str::to_owned).to_vec();
        let rows = found.iter().map(|(name, manifest, step)| match manifest {
            Some((m, _)) => vec![
                name.clone(),
                m.kind.clone(),
                m.lineage.dataset.clone(),
                bytes(m.total_bytes()),
                figures(&m.metrics),
            ],
            None => vec![
                name.clone(),
                "-".into(),
                "-".into(),
                "-".into(),
                match step {
                    Some(step) => format!("not finished: a checkpoint after {step} steps"),
                    None => "not finished, and no whole checkpoint".into(),
                },
            ],
        });
        let mut text = table(&[header].into_iter().chain(rows).collect::<Vec<_>>());
        for (name, manifest, _) in &found {
            if let Some((_, verdict)) = manifest {
                let line = format!("{name}: {}", verdict.text);
                text += &format!("{}\n", show::line(&line));
            }
        }
        text
    });
    Ok(())
}

/// Compares a model with the trivial baselines, by its evaluation on the most scenes.
async fn verdict(models: &Models, manifest: &ModelManifest) -> Result<Verdict> {
    if manifest.kind == "python" {
        return Ok(Verdict {
            doubtful: false,
            text: "an own training, which reports its figures itself".into(),
        });
    }
    let mut evaluations = models.evaluations(&manifest.name).await.map_err(failed)?;
    let sha256 = manifest.sha256();
    evaluations.retain(|e| e.model_sha256 == sha256);
    Ok(match evaluations.iter().max_by_key(|e| e.scenes) {
        Some(evaluation) => Verdict::of_evaluation(&manifest.kind, &evaluation.metrics),
        None => Verdict {
            doubtful: true,
            text: "unknown: it was not evaluated; add a stage `evaluate` that names it".into(),
        },
    })
}

/// Returns the error for a store without models, with the searched location.
pub(super) fn nothing(store: &str) -> CliError {
    let local = !store.contains("://");
    let whole = match local {
        true => {
            std::path::absolute(store).map_or_else(|_| store.into(), |p| p.display().to_string())
        }
        false => store.trim_end_matches('/').to_owned(),
    };
    let what = match local && !Path::new(store).is_dir() {
        true => format!("{whole}: there is no such folder"),
        false => format!("no models in {whole}/models"),
    };
    CliError::input(what).hint(
        "a training keeps its model in the store of the data set that it reads (source.store, or output.store of the stage that \
         makes it); `picofarm job status JOB` names that place. `picofarm job init --kind train` writes a job that trains some",
    )
}

async fn show(store: &str, name: &str, output: Output) -> Result<()> {
    let models = open(store)?;
    let manifest = models.manifest(name).await.map_err(failed)?;
    let evaluations = models.evaluations(name).await.map_err(failed)?;
    let facts = json!({
        "place": models.place(name), "manifest": manifest, "manifest_sha256": manifest.sha256(),
        "evaluations": evaluations,
    });
    output.result(&facts, || {
        described(&models.place(name), &manifest, &evaluations)
    });
    Ok(())
}

fn described(place: &str, manifest: &ModelManifest, evaluations: &[Evaluation]) -> String {
    let from = &manifest.lineage;
    let row = |name: &str, value: String| vec![name.to_owned(), value];
    let mut rows = vec![
        row("model", place.to_owned()),
        row("predicts", manifest.kind.clone()),
        row("manifest", format!("SHA-256 {}", manifest.sha256())),
        row("training key", manifest.training_key.clone()),
        row("code", from.code.clone()),
    ];
    // Own code has no seed that the farm knows.
    if manifest.kind != PythonTask::NAME {
        rows.push(row("seed", from.seed.to_string()));
    }
    rows.extend([
        row(
            "data",
            format!(
                "{}, {} scenes learnt from and {} validated on, id {}",
                from.dataset, from.training_scenes, from.validation_scenes, from.data
            ),
        ),
        row(
            "split",
            format!(
                "{} version {} (SHA-256 {})",
                from.split.name, from.split.version, from.split.sha256
            ),
        ),
    ]);
    for (name, sha256) in &from.models {
        rows.push(row("builds on", format!("{name} (SHA-256 {sha256})")));
    }
    if let Some(promoted) = &from.promoted {
        let values = promoted.values.iter();
        let values: Vec<String> = values.map(|(n, v)| format!("{n} = {}", plain(v))).collect();
        rows.push(row(
            "promoted",
            format!(
                "{}, the best of {} that came to their end, of {}; {}",
                promoted.model,
                promoted.finished,
                promoted.begun,
                values.join(", ")
            ),
        ));
    }
    for object in &manifest.objects {
        rows.push(row(
            "object",
            format!("{}, {}", object.key, bytes(object.size)),
        ));
    }
    for (name, value) in manifest.settings.as_object().into_iter().flatten() {
        rows.push(row(name, plain(value)));
    }
    for (name, value) in manifest.metrics.as_object().into_iter().flatten() {
        rows.push(row(name, plain(value)));
    }
    let mut text = table(&rows);
    for e in evaluations {
        let said = format!(
            "on {} {} scenes of {} ({}, {}): {}",
            e.scenes,
            e.side,
            e.dataset,
            e.histogram,
            e.code,
            figures(&e.metrics)
        );
        let verdict = Verdict::of_evaluation(&manifest.kind, &e.metrics);
        text += &format!("\n{}\n{}\n", show::line(&said), show::line(&verdict.text));
    }
    text
}

async fn export(store: &str, name: &str, out: &Path, output: Output) -> Result<()> {
    let models = open(store)?;
    let manifest = models.manifest(name).await.map_err(failed)?;
    let weights = models.read(&manifest, WEIGHTS).await.map_err(failed)?;
    let failed = |e: std::io::Error| match e.kind() {
        ErrorKind::AlreadyExists => CliError::input(format!("{} exists already", out.display()))
            .hint("name another file with --out, or remove that one"),
        _ => io(out.display(), &e),
    };
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    // The file is written completely or not at all, and never replaces another file.
    let mut file = tempfile::NamedTempFile::new_in(folder).map_err(failed)?;
    file.write_all(&weights).map_err(failed)?;
    file.as_file().sync_all().map_err(failed)?;
    file.persist_noclobber(out).map_err(|e| failed(e.error))?;
    let facts = json!({"model": name, "file": out, "bytes": weights.len(),
                       "sha256": manifest.object(WEIGHTS).map(|o| &o.sha256)});
    output.result(&facts, || {
        format!("{}: {}", out.display(), bytes(weights.len() as u64))
    });
    Ok(())
}

/// Returns the largest number of steps that any training under the name has saved.
fn furthest(checkpoints: &[Checkpoint]) -> Option<u64> {
    let finished = checkpoints.iter().filter(|c| c.finished);
    finished.map(|c| c.step).max()
}

/// Formats a model's numeric figures in one line.
fn figures(metrics: &Value) -> String {
    let mut text = Vec::new();
    for (name, value) in metrics.as_object().into_iter().flatten() {
        match value {
            Value::Object(_) => text.push(format!("{name}: {}", figures(value))),
            _ => text.extend(value.as_f64().map(|x| {
                let whole = x == x.trunc() && x.abs() >= 2.0;
                if whole {
                    format!("{name} {x}")
                } else {
                    format!("{name} {x:.4}")
                }
            })),
        }
    }
    text.join(", ")
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}
