//! `picofarm model verify|repair|remove`: checks, repairs and removes models.

use bytes::Bytes;
use picofarm_results::{Dependents, ModelCheck, ModelManifest, ModelRepair, Models, Removed};
use picofarm_store::{Fault, Problem};
use serde_json::{Value, json};

use super::{nothing, open};
use crate::{
    dataset::failed,
    error::{CliError, Code, Result},
    output::{Output, bytes},
};

/// Maximum number of problem lines shown as text.
const SHOWN: usize = 20;

/// Checks the named models, or all models of a store if none are named.
///
/// # Errors
/// Exit code 6 naming the broken objects.
pub async fn verify(store: &str, names: &[String], output: Output) -> Result<()> {
    let models = open(store)?;
    let names = match names.is_empty() {
        true => models.names().await.map_err(failed)?,
        false => names.to_vec(),
    };
    if names.is_empty() {
        return Err(nothing(store));
    }
    let mut checks = Vec::new();
    for name in names {
        let check = models.verify(&name).await.map_err(failed)?;
        checks.push((name, check));
    }
    let facts: Vec<Value> = checks.iter().map(|(name, c)| facts(name, c)).collect();
    let unsound: Vec<&(String, ModelCheck)> =
        checks.iter().filter(|(_, c)| !c.is_sound()).collect();
    if unsound.is_empty() {
        output.result(&facts, || {
            checks.iter().map(|(name, c)| line(name, c)).collect()
        });
        return Ok(());
    }
    if output.json {
        output.result(&facts, String::new);
    }
    let mut lines = Vec::new();
    for (name, check) in unsound {
        lines.extend(
            check
                .problems
                .iter()
                .map(|p| format!("{name}: {p}\n    {}", remedy(p))),
        );
        if check.removing {
            lines.push(format!(
                "{name}: its removal was interrupted\n    `picofarm model remove` goes on with it"
            ));
        }
    }
    let count = lines.len();
    let more = match count.saturating_sub(SHOWN) {
        0 => String::new(),
        n => format!("\n  … and {n} more (--json lists all)"),
    };
    lines.truncate(SHOWN);
    let what = format!(
        "{store}: {count} problem(s) with models\n  {}{more}",
        lines.join("\n  ")
    );
    Err(CliError::new(Code::Damaged, what))
}

fn facts(name: &str, check: &ModelCheck) -> Value {
    json!({
        "model": name, "finished": check.manifest.is_some(), "objects": check.objects, "bytes": check.bytes,
        "evaluations": check.evaluations, "checkpoints": check.checkpoints, "problems": problems(&check.problems),
        "unused": check.unused, "removing": check.removing,
    })
}

fn problems(problems: &[Problem]) -> Vec<Value> {
    let one = |p: &Problem| json!({"object": p.object, "fault": p.fault.kind(), "what": p.fault.to_string(), "remedy": remedy(p)});
    problems.iter().map(one).collect()
}

fn line(name: &str, check: &ModelCheck) -> String {
    let state = match &check.manifest {
        Some(_) => format!("{} objects, {}: whole", check.objects, bytes(check.bytes)),
        None => "not finished".to_owned(),
    };
    let unused = match check.unused.len() {
        0 => String::new(),
        n => format!(", {n} objects that no manifest names (`picofarm dataset gc` deletes them)"),
    };
    format!(
        "{name}: {state}, {} evaluations, {} checkpoints{unused}\n",
        check.evaluations, check.checkpoints
    )
}

/// Returns the remedy for a problem.
fn remedy(problem: &Problem) -> &'static str {
    match &problem.fault {
        Fault::Foreign => "move it elsewhere; nothing reads it, nothing here deletes it",
        Fault::BadManifest(_) => {
            "nothing says any more what the model is: remove it (`picofarm model remove --force`) and submit its job again"
        }
        Fault::BadRecord(_) if problem.object.contains("/sweeps/") => {
            "delete it; the sweep's job makes the trial again"
        }
        Fault::BadRecord(_) => "`picofarm model repair` deletes it: its job makes it again",
        _ => "`picofarm model repair` puts it back if its bytes are found anywhere",
    }
}

/// Restores the objects of a model as far as possible.
///
/// # Errors
/// Exit code 6 naming the objects that remain broken, and the job that makes them again.
pub async fn repair(store: &str, name: &str, dry: bool, output: Output) -> Result<()> {
    let models = open(store)?;
    let check = models.verify(name).await.map_err(failed)?;
    let made = match &check.manifest {
        Some(manifest) => made_again(&models, manifest).await?,
        None => Vec::new(),
    };
    let done = models.repair(name, &made, dry).await.map_err(failed)?;
    let facts = json!({
        "model": name, "dry_run": dry, "written": done.written, "deleted": done.deleted, "left": problems(&done.left),
    });
    output.result(&facts, || repaired(name, &done, dry));
    if done.left.is_empty() {
        return Ok(());
    }
    let lines: Vec<String> = done
        .left
        .iter()
        .take(SHOWN)
        .map(ToString::to_string)
        .collect();
    let what = format!(
        "{name}: {} problem(s) stay\n  {}",
        done.left.len(),
        lines.join("\n  ")
    );
    Err(CliError::new(Code::Damaged, what).hint(again(name, check.manifest.as_ref())))
}

/// Computes those objects of a model that can be derived again: its figures from the manifest,
/// weights and history from a checkpoint.
async fn made_again(models: &Models, manifest: &ModelManifest) -> Result<Vec<Bytes>> {
    let mut made = vec![Bytes::from(pretty(&manifest.metrics))];
    let newest = models.newest_checkpoint(&manifest.name, &manifest.training_key);
    let newest = newest.await.map_err(failed)?;
    if let Some((_, content)) = newest {
        made.extend(left_by(&content)?);
    }
    Ok(made)
}

/// Returns the weights and the history from a checkpoint; nothing if it cannot be read.
#[cfg(feature = "networks")]
fn left_by(checkpoint: &[Bytes]) -> Result<Vec<Bytes>> {
    let Ok((weights, history)) = picofarm_model::train::left_by(checkpoint) else {
        return Ok(Vec::new());
    };
    let lines = history
        .iter()
        .map(|line| serde_json::to_string(line).expect("plain data") + "\n");
    Ok(vec![weights.into(), lines.collect::<String>().into()])
}

#[cfg(not(feature = "networks"))]
fn left_by(_: &[Bytes]) -> Result<Vec<Bytes>> {
    let what = "networks, which read the checkpoint that this repair begins with";
    Err(crate::error::not_built("networks", what))
}

/// Formats JSON as trainings do in `metrics.json`.
fn pretty(value: &Value) -> Vec<u8> {
    let mut value = value.clone();
    value.sort_all_objects();
    let mut bytes = serde_json::to_vec_pretty(&value).expect("plain data");
    bytes.push(b'\n');
    bytes
}

/// Describes the job that makes a model again.
fn again(name: &str, manifest: Option<&ModelManifest>) -> String {
    let Some(manifest) = manifest else {
        return format!(
            "remove it with `picofarm model remove STORE {name} --force`, and submit the job again that trains it"
        );
    };
    let from = &manifest.lineage;
    format!(
        "no bytes of the recorded SHA-256 were found; `picofarm job submit FILE --from-stage STAGE` with the job that trains {name} (stage \
         of kind \"train\" with model = {name:?} on {}, split {}, seed {}, version {}) trains it again and puts back what comes \
         out equal",
        from.dataset, from.split.name, from.seed, from.code
    )
}

fn repaired(name: &str, done: &ModelRepair, dry: bool) -> String {
    let (wrote, deleted) = match dry {
        true => ("would be written again", "would be deleted"),
        false => ("written again", "deleted"),
    };
    let mut text = String::new();
    for object in &done.written {
        text += &format!("{wrote}: {object}\n");
    }
    for object in &done.deleted {
        text += &format!("{deleted}: {object} (its job makes it again)\n");
    }
    if text.is_empty() && done.left.is_empty() {
        text = format!("{name}: nothing is broken\n");
    }
    text
}

/// Removes a model.
///
/// # Errors
/// Exit code 3 if something builds on it, or it is still being trained, and `force` is not given.
pub async fn remove(
    store: &str,
    name: &str,
    (force, dry): (bool, bool),
    output: Output,
) -> Result<()> {
    let models = open(store)?;
    let dependents = models.dependents(name).await.map_err(failed)?;
    if !dependents.is_empty() && !force && !dry {
        return Err(CliError::input(format!("{name}: {}", builds(&dependents)))
            .hint("remove those first, or give --force: what builds on it stays, and cannot be made again"));
    }
    if dry {
        let check = models.verify(name).await.map_err(failed)?;
        let facts = json!({"model": name, "dry_run": true, "objects": check.objects, "bytes": check.bytes,
                           "models": dependents.models, "predictions": dependents.predictions});
        output.result(&facts, || {
            let size = bytes(check.bytes);
            let on = match dependents.is_empty() {
                true => "nothing builds on it".to_owned(),
                false => builds(&dependents),
            };
            format!(
                "{name}: {} objects, {size}, would be deleted; {on}\n",
                check.objects
            )
        });
        return Ok(());
    }
    let removed = models.remove(name, force).await.map_err(failed)?;
    let reports = models.reports_of(name).await.map_err(failed)?;
    let facts = json!({
        "model": name, "deleted": removed.deleted, "left": removed.left, "reports": reports,
        "models": dependents.models, "predictions": dependents.predictions,
    });
    output.result(&facts, || gone(name, &removed, &dependents, &reports));
    Ok(())
}

fn builds(on: &Dependents) -> String {
    let mut parts = Vec::new();
    if !on.models.is_empty() {
        parts.push(format!(
            "models were trained with it ({})",
            on.models.join(", ")
        ));
    }
    if !on.predictions.is_empty() {
        parts.push(format!(
            "predictions were made with it ({})",
            on.predictions.join(", ")
        ));
    }
    parts.join("; ")
}

fn gone(name: &str, removed: &Removed, on: &Dependents, reports: &[String]) -> String {
    let mut text = format!("{name}: {} objects deleted\n", removed.deleted.len());
    for object in &removed.left {
        text += &format!("remains: {object} (not this model's)\n");
    }
    if !on.is_empty() {
        text += &format!("remains, and cannot be made again: {}\n", builds(on));
    }
    if !reports.is_empty() {
        text += &format!("reports that show it stay: {}\n", reports.join(", "));
    }
    text
}
