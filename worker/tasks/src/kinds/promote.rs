//! Promotion: gives the best of several models a name of its own. The promoted model is a
//! byte-for-byte copy of the training's result, and its manifest lists the candidates.

use picofarm_model::metric::Metrics;
use picofarm_proto::spec::{PromoteTask, TaskKind as _};
use picofarm_results::{ModelManifest, NewModel, Promoted, TrialRecord};
use picofarm_store::published::Manifest as _;
use tracing::info;

use crate::{
    errors::in_field,
    input::models::model_version,
    stores::Stores,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

impl RunTask for PromoteTask {
    fn code_version() -> String {
        model_version()
    }

    /// Promotes the best of the models that `task` names.
    fn run(&self, context: &Context, _task: &Task, control: &Control) -> Result<Output, TaskError> {
        let stores = &context.stores;
        let task = self;
        let settings = &task.promote;
        let models = stores
            .models(task.store(), control)
            .map_err(|e| in_field(task.results().field, e))?;
        let (mut best, mut finished): (Option<(f64, ModelManifest)>, u64) = (None, 0);
        for (i, name) in settings.among.iter().enumerate() {
            let field = format!("promote.among[{i}]");
            let looked = stores.wait(control, models.look(name));
            let Some(manifest) = looked.map_err(|e| in_field(&field, e))? else {
                let Some(left) = trial_of(stores, &models, name, control)? else {
                    if settings.tolerate_missing {
                        info!("{name} is not there: passed over");
                        continue;
                    }
                    // The error lists the existing models.
                    let missing = stores.wait(control, models.manifest(name));
                    missing.map_err(|e| in_field(&field, e))?;
                    continue;
                };
                info!("{name} stopped after {} epochs: passed over", left.epochs);
                continue;
            };
            finished += 1;
            let loss = loss(&manifest).map_err(|e| in_field(&field, e))?;
            if let Some((_, other)) = &best
                && other.kind != manifest.kind
            {
                return Err(TaskError::User(format!(
                    "{field}: {name:?} predicts {:?}, {:?} predicts {:?}; choose among models of one kind",
                    manifest.kind, other.name, other.kind
                )));
            }
            if best.as_ref().is_none_or(|(least, _)| loss < *least) {
                best = Some((loss, manifest));
            }
        }
        let begun = settings.among.len() as u64;
        let Some((loss, chosen)) = best else {
            return Err(TaskError::User(format!(
                "promote.among: none of {begun} models came to its end; look at them with `picofarm sweep status`"
            )));
        };
        info!(
            "{} is the best of {finished} that came to their end ({loss:.4}), of {begun}: it is {} now",
            chosen.name, settings.model
        );
        let mut objects = Vec::with_capacity(chosen.objects.len());
        for object in &chosen.objects {
            let file = object.key.rsplit('/').next().unwrap_or(&object.key);
            let bytes = stores.wait(control, models.read(&chosen, file))?;
            objects.push((file.to_owned(), bytes));
        }
        let trial = trial_of(stores, &models, &chosen.name, control)?;
        let speed = stores.wait(control, models.speed(&chosen.name, &chosen.training_key))?;
        if let Some(speed) = speed {
            stores.wait(control, models.put_speed(&settings.model, &speed))?;
        }
        let mut manifest = chosen.clone();
        manifest.name.clone_from(&settings.model);
        manifest.lineage.promoted = Some(Promoted {
            manifest_sha256: chosen.sha256(),
            model: chosen.name,
            values: trial.map(|trial| trial.values).unwrap_or_default(),
            finished,
            begun,
        });
        let new = NewModel { manifest, objects };
        let published = stores
            .patiently(control, async || models.publish(new.clone(), false).await)
            .map_err(|e| in_field("promote.model", e))?;
        control.at(1.0);
        Ok(Output {
            manifest_sha256: published.manifest.sha256(),
            bytes: published.manifest.total_bytes(),
            adopted: published.adopted,
        })
    }
}

/// Returns the loss of a model on the validation scenes at the end of its training: MAE in metres,
/// or 1 − IoU; for an own training, its objective.
fn loss(manifest: &ModelManifest) -> Result<f64, TaskError> {
    if let Some(objective) = manifest.metrics.get("objective") {
        return objective["loss"].as_f64().ok_or_else(|| {
            TaskError::User(format!(
                "{:?} reported no {}; report it at the end of the training",
                manifest.name, objective["metric"]
            ))
        });
    }
    let found = manifest.metrics.get("validation").cloned();
    let found: Option<Metrics> = found.and_then(|m| serde_json::from_value(m).ok());
    found.map(|m| m.loss()).ok_or_else(|| {
        TaskError::User(format!(
            "{:?} was validated on no scenes, so nothing tells how good it is; train it with a split that has some",
            manifest.name
        ))
    })
}

/// Returns the record of the trial that trained a model, if any.
fn trial_of(
    stores: &Stores,
    models: &picofarm_results::Models,
    model: &str,
    control: &Control,
) -> Result<Option<TrialRecord>, TaskError> {
    let Some((sweep, index)) = model.rsplit_once('.') else {
        return Ok(None);
    };
    let Ok(index) = index.parse() else {
        return Ok(None);
    };
    for id in stores.wait(control, models.sweeps(sweep))? {
        let trial = stores.wait(control, models.trial(sweep, &id, index))?;
        if let Some(trial) = trial.filter(|trial| trial.model == model) {
            return Ok(Some(trial));
        }
    }
    Ok(None)
}
