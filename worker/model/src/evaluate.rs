//! Models before scenes that they have not seen: figures, beside those of trivial answers.

use serde::{Deserialize, Serialize};

use crate::{
    ModelError,
    baseline::Baseline,
    input::{Batch, Target, Visit, example},
    metric::{Metrics, Released, Tally},
    model::Model,
    scene::{Scene, Scenes},
};

/// What an evaluation found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluated {
    /// Of all scenes together.
    pub metrics: Metrics,
    /// The same by the released code's formulas.
    pub released: Released,
    /// Of trivial answers, by name: see [`Baseline::names`].
    pub baselines: Vec<(String, Metrics)>,
    /// Of each scene, in order.
    pub scenes: Vec<Metrics>,
    /// Examples: scenes, times spots where a network is asked spot by spot.
    pub examples: u64,
}

/// What a model and the trivial answers said of one scene: what figures follow from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answered {
    examples: u64,
    model: Tally,
    /// Those of trivial answers, by name.
    trivial: Vec<(String, Tally)>,
}

impl Evaluated {
    /// Of scenes in order: the same to the bit in however many parts they were asked.
    pub fn of(target: Target, scenes: &[Answered]) -> Self {
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

/// Asks a model of every scene, spot by spot where it is a shadow network. `baseline` is what it is compared with. `tell` hears
/// how many scenes are done of how many and says whether to go on; where it does not, there is no answer.
///
/// # Errors
/// [`ModelError::Scene`], [`ModelError::Invalid`] for scenes that do not fit the model or the baseline,
/// [`ModelError::Answer`] for the first answer that is no finite number.
pub fn evaluate(
    model: &Model,
    baseline: &Baseline,
    scenes: &dyn Scenes,
    tell: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<Evaluated>, ModelError> {
    let answered = answered(model, baseline, scenes, tell)?;
    let target = model.question().target;
    Ok(answered.map(|scenes| Evaluated::of(target, &scenes)))
}

/// What is answered of every scene, in order, from which [`Evaluated::of`] makes figures; arguments and errors as
/// [`evaluate`].
///
/// # Errors
/// As [`evaluate`].
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

fn of_scene(model: &Model, baseline: &Baseline, scene: &Scene) -> Result<Answered, ModelError> {
    let question = model.question();
    let names = baseline.names().iter();
    let mut found = Answered {
        examples: 0,
        model: Tally::default(),
        trivial: names
            .map(|name| ((*name).to_owned(), Tally::default()))
            .collect(),
    };
    let (mut plane, mut fits) = (0, true);
    answers(model, scene, &mut |said, batch| {
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

/// What a model says of a scene: once, or for each spot. Hears outputs (outputs, H, W) and what was asked.
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

/// The same where `hear` says whether to go on; `false` where it did not.
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

/// The masks that a model says of a scene: probabilities times 255, rounded, `[row][column]` of mirrors,
/// `[spot][row][column]` of light. `tell` hears how many visits are done of how many and says whether to go on; where it does
/// not, there is no answer.
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

/// 1/(1 + e^−x) times 255, rounded; x is a finite number.
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
