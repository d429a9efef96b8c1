//! Resolves references of stages to earlier stages: data sets, models (which may be named by the
//! stages that train them), splits, and evaluations.
//!
//! A name refers first to a model that an earlier stage trains, then to a stage. A resolved job
//! contains only names of models, so that it means the same when it is read again.

use super::{
    kinds::{Makes, ModelNames},
    places::SourceSettings,
    spec_error::SpecError,
    stage::StageSpec,
};

/// Fills in values that follow from other stages: places, needs and numbers of scenes.
///
/// # Errors
/// Returns an error for a source that no earlier stage makes.
pub(super) fn resolve(stages: &mut [StageSpec]) -> Result<(), SpecError> {
    for i in 0..stages.len() {
        let (before, rest) = stages.split_at_mut(i);
        let stage = &mut rest[0];
        let mut needs = Vec::with_capacity(stage.needs.len());
        for need in stage.needs.drain(..) {
            let instance = format!("{need}[");
            let all = before.iter().map(|s| &s.name);
            let mut all = all.filter(|n| n.starts_with(&instance)).peekable();
            if before.iter().any(|s| s.name == need) || all.peek().is_none() {
                needs.push(need);
            } else {
                needs.extend(all.cloned());
            }
        }
        stage.needs = needs;
        let Some((source, count)) = stage.task.reads_mut() else {
            link(stage, before)?;
            continue;
        };
        if source.store.is_empty() && !source.dataset.is_empty() {
            let named = before.iter().find(|s| s.name == source.dataset);
            let Some((store, dataset)) = named.and_then(|s| s.task.makes()) else {
                return Err(SpecError::new(
                    format!("stage.{}.source", stage.name),
                    format!(
                        "{:?} is no stage before this one that makes a data set; for one that exists, write \
                             {{ store = \"…\", dataset = \"…\" }}",
                        source.dataset
                    ),
                ));
            };
            *source = SourceSettings {
                store: store.clone(),
                dataset: dataset.clone(),
            };
        }
        let place = (&source.store, &source.dataset);
        if let Some(maker) = before.iter().find(|s| s.task.writes() == Some(place)) {
            if *count == 0 {
                *count = maker.tasks();
            }
            if !stage.needs.contains(&maker.name) {
                stage.needs.push(maker.name.clone());
            }
        }
        link(stage, before)?;
    }
    Ok(())
}

/// Replaces names of stages by names of models. Adds to `stage.needs` the stages in `before` that
/// make its models, split or evaluations.
///
/// # Errors
/// Returns an error for a name that means several models where one is required, or a stage that
/// trains no model.
fn link(stage: &mut StageSpec, before: &[StageSpec]) -> Result<(), SpecError> {
    if stage.task.models_store().is_some_and(String::is_empty) {
        let models = stage
            .task
            .models()
            .into_iter()
            .map(|(_, name)| name.clone());
        let found = store_of(&models.collect::<Vec<_>>(), before);
        if let Some(store) = stage.task.models_store_mut() {
            *store = found;
        }
    }
    let Some(store) = stage.task.models_store().cloned() else {
        return Ok(());
    };
    let source = stage.task.reads().cloned();
    let in_stage = |field: &str| format!("stage.{}.{field}", stage.name);
    if let Some((field, folder)) = stage.task.io_mut().folder {
        let found = written_folder(folder, before, &store)
            .map_err(|e| SpecError::new(in_stage(field), e))?;
        if let Some(found) = found {
            *folder = found;
        }
    }
    match stage.task.io_mut().models {
        ModelNames::Single(names) => {
            for (field, name) in names {
                let mut found =
                    named(name, before, &store).map_err(|e| SpecError::new(in_stage(field), e))?;
                if found.len() > 1 {
                    let what = format!(
                        "{name:?} stands for {} models; name one stage, as \"{}\"",
                        found.len(),
                        found[0].0
                    );
                    return Err(SpecError::new(in_stage(field), what));
                }
                if let Some((_, model)) = found.pop() {
                    *name = model;
                }
            }
        }
        ModelNames::List(field, names) => {
            all(names, before, &store).map_err(|e| SpecError::new(in_stage(field), e))?;
        }
    }
    let io = stage.task.io();
    let models = &io.models;
    let read = |name: &String| models.iter().any(|(_, model)| *model == name);
    let wanted = before.iter().filter(|s| {
        let divides = s.task.divides().is_some_and(|(divided, name)| {
            Some(divided) == source.as_ref() && io.split == Some(name)
        });
        // A report uses the evaluations of its models.
        let evaluates = matches!(io.makes, Makes::Report(..))
            && s.task.models_store() == Some(&store)
            && s.task.io().makes == Makes::Evaluations
            && s.task.models().into_iter().any(|(_, model)| read(model));
        let trains = s
            .task
            .trains()
            .is_some_and(|(place, model)| *place == store && read(model));
        let folder = io
            .folder
            .is_some_and(|(_, folder)| s.task.writes() == Some((&store, folder)));
        divides || evaluates || trains || folder
    });
    let wanted: Vec<String> = wanted.map(|s| s.name.clone()).collect();
    for name in wanted {
        if !stage.needs.contains(&name) {
            stage.needs.push(name);
        }
    }
    Ok(())
}

/// Returns the folder that the stage with this name writes; `None` if the name is a folder's.
fn written_folder(name: &str, before: &[StageSpec], store: &str) -> Result<Option<String>, String> {
    // A folder that a stage writes refers to itself, so that a job may be read again.
    let written = |s: &StageSpec| s.task.writes().is_some_and(|(_, to)| to == name);
    if before.iter().any(written) {
        return Ok(None);
    }
    let instance = format!("{name}[");
    if let Some(one) = before.iter().find(|s| s.name.starts_with(&instance)) {
        return Err(format!(
            "{name:?} stands for several stages; name one, as {:?}",
            one.name
        ));
    }
    let Some(stage) = before.iter().find(|s| s.name == name) else {
        return Ok(None);
    };
    match stage.task.writes() {
        Some((place, to)) if place == store => Ok(Some(to.clone())),
        Some((place, _)) => Err(format!(
            "{name:?} writes into {place}, but its folder is looked for in the store of the data set, {store}"
        )),
        None => Err(format!(
            "{name:?} is a stage that keeps nothing of scenes; name an infer stage"
        )),
    }
}

/// Replaces each name by all models that it means.
fn all(names: &mut Vec<String>, before: &[StageSpec], store: &str) -> Result<(), String> {
    let mut models = Vec::with_capacity(names.len());
    for name in names.drain(..) {
        let found = named(&name, before, store)?;
        match found.is_empty() {
            true => models.push(name),
            false => models.extend(found.into_iter().map(|(_, model)| model)),
        }
    }
    *names = models;
    Ok(())
}

/// Returns the store of the first stage that trains one of `names`; empty if no stage does.
fn store_of(names: &[String], before: &[StageSpec]) -> String {
    let meant = |stage: &&StageSpec| {
        stage.task.trains().is_some_and(|(_, model)| {
            let base = stage.name.split('[').next();
            let is = |name: &String| name == model || *name == stage.name || Some(&**name) == base;
            names.iter().any(is)
        })
    };
    let found = before.iter().find(meant);
    found
        .and_then(|stage| stage.task.models_store())
        .cloned()
        .unwrap_or_default()
}

/// Returns the stages that train the models meant by `name`, each with its model; none if it is an
/// existing model.
fn named(name: &str, before: &[StageSpec], store: &str) -> Result<Vec<(String, String)>, String> {
    let trained = |s: &&StageSpec| s.task.trains().is_some_and(|(_, model)| model == name);
    if before.iter().any(|s| trained(&s)) {
        return Ok(Vec::new());
    }
    let instance = format!("{name}[");
    let stages = before
        .iter()
        .filter(|s| s.name == name || s.name.starts_with(&instance));
    stages
        .map(|stage| match stage.task.trains() {
            Some((place, model)) if place == store => Ok((stage.name.clone(), model.clone())),
            Some((place, _)) => Err(format!(
                "{:?} keeps its model in {place}, but models are looked for in the store of the data set, {store}",
                stage.name
            )),
            None => Err(format!("{:?} is a stage that trains no model", stage.name)),
        })
        .collect()
}
