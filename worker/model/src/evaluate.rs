//! The evaluation of models on unseen scenes, compared with trivial answers.

use serde::{Deserialize, Serialize};

use crate::{
    ModelError,
    baseline::Baseline,
    input::{Batch, Question, Target, Visit, example},
    metric::{Metrics, Released, Tally},
    model::Model,
    scene::{Scene, Scenes, Unreadable},
};

/// The result of an evaluation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluated {
    /// The metrics over all scenes.
    pub metrics: Metrics,
    /// The metrics by the released code's formulas.
    pub released: Released,
    /// The metrics of trivial answers, by name: see [`Baseline::names`].
    pub baselines: Vec<(String, Metrics)>,
    /// The metrics of each scene, in order.
    pub scenes: Vec<Metrics>,
    /// The number of examples: scenes, multiplied by the spots if a network is queried spot by
    /// spot.
    pub examples: u64,
}

/// The answers of a model and of the trivial answers for one scene, as the sums from which metrics
/// are computed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answered {
    examples: u64,
    model: Tally,
    /// The sums of the trivial answers, by name.
    trivial: Vec<(String, Tally)>,
}

impl Evaluated {
    /// Computes the metrics of scenes in order. The result is identical to the bit however the
    /// scenes were divided among evaluations.
    pub fn from_scenes(target: Target, scenes: &[Answered]) -> Self {
        let mut whole = Tally::default();
        let mut trivial: Vec<(String, Tally)> = Vec::new();
        for scene in scenes {
            whole.join(&scene.model);
            for (name, of) in &scene.trivial {
                match trivial.iter_mut().find(|(n, _)| n == name) {
                    Some((_, all)) => all.join(of),
                    None => trivial.push((name.clone(), of.clone())),
                }
            }
        }
        let named = trivial.into_iter();
        Self {
            metrics: whole.metrics(target),
            released: whole.released(target),
            baselines: named
                .map(|(name, tally)| (name, tally.metrics(target)))
                .collect(),
            scenes: scenes.iter().map(|s| s.model.metrics(target)).collect(),
            examples: scenes.iter().map(|s| s.examples).sum(),
        }
    }
}

/// Evaluates a model on every scene, spot by spot if it is a shadow network, and compares it with
/// `baseline`. `tell` receives the number of finished scenes and their total and returns whether to
/// continue. If it returns `false`, there is no result.
///
/// # Errors
/// [`ModelError::Scene`], [`ModelError::Invalid`] for scenes that do not fit the model or the
/// baseline, [`ModelError::Answer`] for the first answer with a non-finite number.
pub fn evaluate(
    model: &Model,
    baseline: &Baseline,
    scenes: &dyn Scenes,
    tell: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<Evaluated>, ModelError> {
    let answered = answered(model, baseline, scenes, tell)?;
    let target = model.question().target;
    Ok(answered.map(|scenes| Evaluated::from_scenes(target, &scenes)))
}

/// Returns the answers for every scene, in order; [`Evaluated::of`] computes the metrics from them.
/// The arguments are those of [`evaluate`].
///
/// # Errors
/// As for [`evaluate`].
pub fn answered(
    model: &Model,
    baseline: &Baseline,
    scenes: &dyn Scenes,
    tell: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<Vec<Answered>>, ModelError> {
    let mut each = Vec::with_capacity(scenes.len());
    for index in 0..scenes.len() {
        let scene = scenes.load(index).map_err(|source| ModelError::Scene {
            scene: index,
            source,
        })?;
        let answered = of_scene(model, baseline, &scene);
        each.push(answered.map_err(|e| e.in_scene(index))?);
        if !tell(index + 1, scenes.len()) {
            return Ok(None);
        }
    }
    Ok(Some(each))
}

/// Returns the answers for every scene, in order, from predictions that are stored instead of made
/// here. `said` returns those of a scene by its index, for all spots if the question is about
/// shadows: z-depths in metres, or probabilities of masks. The other arguments are those of
/// [`evaluate`]; the question's variant must be [`ShadowVariant::All`].
///
/// # Errors
/// [`ModelError::Scene`] for scenes and predictions that cannot be read; [`ModelError::Invalid`]
/// for those that do not fit the question or the baseline.
pub fn answered_by(
    question: &Question,
    said: &mut dyn FnMut(usize) -> Result<Vec<f32>, Unreadable>,
    baseline: &Baseline,
    scenes: &dyn Scenes,
    tell: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<Vec<Answered>>, ModelError> {
    let mut each = Vec::with_capacity(scenes.len());
    for index in 0..scenes.len() {
        let unreadable = |source| ModelError::Scene {
            scene: index,
            source,
        };
        let scene = scenes.load(index).map_err(unreadable)?;
        let mut said = said(index).map_err(unreadable)?;
        for x in &mut said {
            *x = match question.target {
                Target::Tof => (*x / question.depth_scale_m).clamp(0.0, 1.0),
                // A mask is set from a half on: the sign of a logit.
                Target::Shadow | Target::Specular => *x - 0.5,
            };
        }
        let answered = tallied(question, baseline, &scene, &mut |hear| {
            let mut batch = Batch::default();
            example(&mut batch, question, &scene, Visit::default())?;
            if said.len() != batch.target.len() {
                let what = format!(
                    "have {} values, the truth has {}",
                    said.len(),
                    batch.target.len()
                );
                return Err(ModelError::invalid("predictions", what));
            }
            hear(&said, &batch);
            Ok(())
        });
        each.push(answered.map_err(|e| e.in_scene(index))?);
        if !tell(index + 1, scenes.len()) {
            return Ok(None);
        }
    }
    Ok(Some(each))
}

fn of_scene(model: &Model, baseline: &Baseline, scene: &Scene) -> Result<Answered, ModelError> {
    tallied(model.question(), baseline, scene, &mut |hear| {
        answers(model, scene, hear)
    })
}

/// Receives outputs and the batch that they answer.
type Hear<'a> = &'a mut dyn FnMut(&[f32], &Batch);

/// Compares the outputs for a scene, which `each` passes on, and the trivial answers with the
/// truth.
fn tallied(
    question: &Question,
    baseline: &Baseline,
    scene: &Scene,
    each: &mut dyn FnMut(Hear) -> Result<(), ModelError>,
) -> Result<Answered, ModelError> {
    let names = baseline.names().iter();
    let mut found = Answered {
        examples: 0,
        model: Tally::default(),
        trivial: names
            .map(|name| ((*name).to_owned(), Tally::default()))
            .collect(),
    };
    let (mut plane, mut fits) = (0, true);
    each(&mut |said, batch| {
        let (side, truth) = ([batch.height, batch.width], &batch.target);
        found.examples += batch.images as u64;
        found.model.add(question, said, truth, side);
        let trivial = baseline.answers(question, scene, plane, truth.len());
        for ((_, tally), said) in found.trivial.iter_mut().zip(trivial) {
            fits &= said.len() == truth.len();
            tally.add(question, &said, truth, side);
        }
        plane += truth.len() / scene.pixels();
    })?;
    match fits {
        true => Ok(found),
        false => Err(ModelError::invalid(
            "scenes",
            "the training scenes that trivial answers are fitted to have another size or number of spots",
        )),
    }
}

/// Computes a model's outputs for a scene: once, or for each spot. `hear` receives the outputs
/// (outputs, H, W) and the input batch.
///
/// # Errors
/// [`ModelError::Invalid`] for a scene that does not fit the model.
pub fn answers(
    model: &Model,
    scene: &Scene,
    hear: &mut dyn FnMut(&[f32], &Batch),
) -> Result<(), ModelError> {
    answers_while(model, scene, &mut |said, batch| {
        hear(said, batch);
        true
    })
    .map(drop)
}

/// Like [`answers`], but `hear` returns whether to continue. Returns `false` if it stopped the
/// computation.
fn answers_while(
    model: &Model,
    scene: &Scene,
    hear: &mut dyn FnMut(&[f32], &Batch) -> bool,
) -> Result<bool, ModelError> {
    let question = model.question();
    let spots = if question.by_spot() {
        question.spots
    } else {
        1
    };
    for spot in 0..spots {
        let mut batch = Batch::default();
        let visit = Visit {
            spot,
            ..Visit::default()
        };
        example(&mut batch, question, scene, visit)?;
        let asked_of = question.by_spot().then_some(spot);
        if !hear(&model.finite_answer(&batch, asked_of)?, &batch) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Returns the masks that a model predicts for a scene: probabilities times 255, rounded, as
/// `[row][column]` for mirrors and `[spot][row][column]` for light. `tell` receives the number of
/// finished visits and their total and returns whether to continue. If it returns `false`, there is
/// no result.
///
/// # Errors
/// [`ModelError::Invalid`] for a depth network, and for a scene that does not fit the model.
pub fn masks(
    model: &Model,
    scene: &Scene,
    tell: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<Vec<u8>>, ModelError> {
    let question = model.question();
    if question.target == Target::Tof {
        return Err(ModelError::invalid(
            "models",
            "a depth network says no mask",
        ));
    }
    let visits = match question.by_spot() {
        true => question.spots,
        false => 1,
    };
    let (mut masks, mut done) = (Vec::new(), 0);
    let whole = answers_while(model, scene, &mut |said, _| {
        masks.extend(said.iter().map(|logit| probability(*logit)));
        done += 1;
        tell(done, visits)
    })?;
    Ok(whole.then_some(masks))
}

/// Returns 1/(1 + e^−x) times 255, rounded; x must be finite.
fn probability(logit: f32) -> u8 {
    (255.0 / (1.0 + libm::exp(-f64::from(logit)))).round() as u8
}

#[cfg(test)]
mod tests {
    use super::probability;

    #[test]
    fn probabilities_of_logits_fill_a_byte() {
        let said = [-100.0, -1.0, 0.0, 1.0, 100.0].map(probability);
        assert_eq!(said, [0, 69, 128, 186, 255]);
    }
}
