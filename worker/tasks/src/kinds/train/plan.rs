//! Converts a job's settings and a data set into the model runtime's plan.

use picofarm_dataset::DatasetSpec;
use picofarm_model::{
    ModelError,
    input::{self, EvidenceForm, Question},
    net::NetSpec,
    scene::Scenes,
    train::Plan,
};
use picofarm_proto::spec::{
    TrainSettings,
    train::{Normalise, Schedule, Target},
};

use crate::{
    errors::model_error,
    input::models::Known,
    task::{Control, TaskError},
};

/// Returns the plan of a network for scenes of a data set. `spots` is the number of spots that
/// contribute to the histogram, `evidence` the form of evidence that is read instead. `greatest` is
/// the largest bin, for the logarithm.
///
/// # Errors
/// [`TaskError::User`] naming the setting that does not fit the data set.
pub(super) fn plan(
    settings: &TrainSettings,
    spec: &DatasetSpec,
    (spots, evidence): (usize, Option<EvidenceForm>),
    greatest: f32,
) -> Result<Plan, TaskError> {
    let (input, optimise) = (&settings.input, &settings.optimise);
    let some = |value: f64| (value > 0.0).then_some(value);
    let user = |field: &str, what: String| TaskError::User(format!("train.{field}: {what}"));
    let bins = match input.bins {
        0 => spec.gate.bins,
        bins => bins,
    };
    input::merged(spec.gate.bins as usize, bins as usize)
        .map_err(|what| user("input.bins", what))?;
    let question = Question {
        target: settings.target,
        variant: settings.shadow.variant,
        normalise: match input.normalise {
            Normalise::Minmax => input::Normalise::MinMax,
            Normalise::Log => input::Normalise::Log { greatest },
        },
        bins: bins as usize,
        intensity_only: input.intensity_only,
        spots: match settings.target {
            Target::Shadow => spots,
            _ => 0,
        },
        depth_scale_m: settings.depth_scale_m as f32,
        evidence,
    };
    let (dense, one_hot, outputs) = question.channels();
    let wanted = &settings.net;
    let net = NetSpec {
        architecture: wanted.architecture,
        dense,
        one_hot,
        outputs,
        width: wanted.width as usize,
        levels: wanted.levels as usize,
        stem: wanted.stem as usize,
        stem_form: wanted.stem_form,
        time: wanted.time_features as usize,
        time_projection: wanted.time_projection,
        swin: wanted.swin,
        added: question.sees_evidence(),
        frozen: !settings.specular.on.is_empty(),
        precision: optimise.precision,
    };
    let multiple = net.multiple() as u32;
    if !spec.height.is_multiple_of(multiple) || !spec.width.is_multiple_of(multiple) {
        let (field, why) = net.why_multiple();
        let what = format!(
            "{why}, so that the sides of images must be multiples of {multiple}; the data set has {}x{} pixels",
            spec.width, spec.height
        );
        return Err(user(field, what));
    }
    Ok(Plan {
        question,
        net,
        epochs: optimise.epochs.into(),
        batch: (optimise.batch / optimise.accumulate) as usize,
        accumulate: optimise.accumulate as usize,
        learning_rate: optimise.learning_rate,
        decay: optimise.weight_decay,
        schedule: optimise.schedule,
        restarts: (optimise.schedule == Schedule::Restarts).then_some((
            optimise.restarts.first.into(),
            optimise.restarts.factor.into(),
        )),
        clip_norm: some(optimise.clip_norm),
        ema: some(optimise.ema),
        augment: settings.augment,
        early_stop: optimise.early_stop.into(),
        validate_every: optimise.validate_every.into(),
        seed: settings.seed,
    })
}

/// Rejects a network that builds on the features of another network with a different input or
/// shape.
pub(super) fn check_on(plan: &Plan, on: &Known) -> Result<(), TaskError> {
    let (ours, theirs) = (&plan.question, on.model.question());
    let (net, under) = (&plan.net, &on.model.plan().net);
    let text = |value: &dyn std::fmt::Debug| format!("{value:?}");
    for (field, ours, theirs) in [
        ("input.bins", text(&ours.bins), text(&theirs.bins)),
        (
            "input.normalise",
            text(&ours.normalise),
            text(&theirs.normalise),
        ),
        (
            "input.intensity_only",
            text(&ours.intensity_only),
            text(&theirs.intensity_only),
        ),
        (
            "net.architecture",
            text(&net.architecture),
            text(&under.architecture),
        ),
        ("net.width", text(&net.width), text(&under.width)),
        ("net.levels", text(&net.levels), text(&under.levels)),
        ("net.stem", text(&net.stem), text(&under.stem)),
        (
            "net.stem_form",
            text(&net.stem_form),
            text(&under.stem_form),
        ),
        ("net.time_features", text(&net.time), text(&under.time)),
        (
            "net.time_projection",
            text(&net.time_projection),
            text(&under.time_projection),
        ),
        ("net.swin", text(&net.swin), text(&under.swin)),
    ] {
        if ours != theirs {
            return Err(TaskError::User(format!(
                "train.{field}: is {ours}, but {theirs} in {:?}, whose features it is built on; give both the same",
                on.manifest.name
            )));
        }
    }
    Ok(())
}

/// Returns the largest bin of all scenes.
pub(super) fn largest_bin(scenes: &dyn Scenes, control: &Control) -> Result<f32, TaskError> {
    let mut max = 0.0f32;
    for index in 0..scenes.len() {
        control.say(
            format!(
                "looks for the largest bin: scene {index} of {}",
                scenes.len()
            ),
            &[],
        );
        if control.stopped() {
            return Err(TaskError::Stopped);
        }
        let scene = scenes.load(index).map_err(|source| {
            model_error(ModelError::Scene {
                scene: index,
                source,
            })
        })?;
        max = scene.histogram.iter().copied().fold(max, f32::max);
    }
    match max > 0.0 {
        true => Ok(max),
        false => Err(TaskError::User(
            "train.input.normalise: \"log\" needs light, but every bin of every training scene is 0".into(),
        )),
    }
}
