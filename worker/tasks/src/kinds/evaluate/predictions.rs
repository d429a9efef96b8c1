//! Evaluation of stored predictions, by networks or by physics: depth and masks are compared with
//! the truth by the metrics of models, so that their figures may be compared. The result is stored
//! next to the predictions.

use picofarm_model::{
    Evaluated, answered_by,
    baseline::Baseline,
    input::{DEPTH_SCALE_M, Normalise, Question, ShadowVariant, Target},
    scene::Unreadable,
};
use picofarm_proto::{key::evaluation_key, spec::Histogram};
use picofarm_results::{Evaluation, Predicted, Predictions, Verdict};
use picofarm_store::sha256_hex;
use tracing::info;

use super::{BASELINE, EvaluationRun, metrics, summary};
use crate::{
    errors::{in_field, model_error},
    input::{
        examples::Examples,
        truth::{self, Need},
    },
    stores::saying,
    task::{Control, Output, TaskError},
};

const FIELD: &str = "evaluate.predictions";

impl EvaluationRun<'_> {
    /// Evaluates each predicted quantity.
    pub(super) fn of_predictions(&self, control: &Control) -> Result<Output, TaskError> {
        let folder = &self.task.evaluate.predictions;
        let (store, prefix) = self.stores.probed(&self.task.source.store, control)?;
        let opened = Predictions::open(store, prefix.join(&**folder));
        let there = self
            .stores
            .wait(control, opened)
            .map_err(|e| in_field(FIELD, e))?;
        let (theirs, ours) = (there.spec(), self.dataset.spec());
        if (theirs.height, theirs.width) != (ours.height, ours.width) {
            return Err(TaskError::User(format!(
                "{FIELD}: {} has images of {}x{} pixels, the data set of {}x{}; name predictions of this data set",
                there.place(),
                theirs.width,
                theirs.height,
                ours.width,
                ours.height
            )));
        }
        let kinds = [
            (Target::Tof, Need::Depth, theirs.depth),
            (Target::Shadow, Need::Visibility, !theirs.spots.is_empty()),
            (Target::Specular, Need::Specular, theirs.specular),
        ];
        let (mut documents, mut computed) = (Vec::new(), false);
        for (target, need, _) in kinds.into_iter().filter(|(_, _, predicted)| *predicted) {
            // Physics always predicts mirrors, and few imports have their truth.
            let place = self.dataset.place();
            let known = truth::check(&place, &[need], &self.data.missing)
                .and_then(|()| truth::check(&place, &[need], &self.known_data.missing));
            if target == Target::Specular && known.is_err() {
                let text = format!("mirrors are not compared: {place} has no truth of them");
                info!("{text}");
                control.say(text, &[]);
                continue;
            }
            known?;
            let (found, new) = self.of_quantity(&there, target, control)?;
            computed |= new;
            documents.extend(found.to_bytes());
        }
        control.at(1.0);
        Ok(Output {
            manifest_sha256: sha256_hex(&documents),
            bytes: documents.len() as u64,
            adopted: !computed,
        })
    }

    /// Returns the evaluation of one quantity, and whether it was computed by this task.
    fn of_quantity(
        &self,
        there: &Predictions,
        target: Target,
        control: &Control,
    ) -> Result<(Evaluation, bool), TaskError> {
        let (stores, settings) = (self.stores, &self.task.evaluate);
        let pinned = there.pin(target.name(), &self.scenes, &self.data.manifests);
        let pinned = stores
            .wait(control, pinned)
            .map_err(|e| in_field(FIELD, e))?;
        let model = pinned.model.unwrap_or_default();
        let histogram = Histogram::parse(&model.histogram).map_err(TaskError::User)?;
        let key = evaluation_key(
            &pinned.id,
            [&*self.data.id, &*self.known_data.id],
            target.name(),
            (histogram, &model.spots),
            false,
            &settings.version,
        )
        .to_string();
        let name = format!("{} in {}", target.name(), settings.predictions);
        if let Some(found) = stores.wait(control, there.evaluation(&key))? {
            tell(&name, target, &found);
            return Ok((found, false));
        }
        let question = Question {
            target,
            variant: ShadowVariant::All,
            normalise: Normalise::default(),
            bins: self.dataset.spec().gate.bins as usize,
            // The histogram is not looked at.
            intensity_only: true,
            spots: there.spec().spots.len(),
            depth_scale_m: DEPTH_SCALE_M,
            evidence: None,
        };
        // The truth of the spots that the predictions are about, in their order.
        let shown = (histogram, &*model.spots);
        let examples = |scenes: &[u64]| {
            Examples::new(stores, &self.dataset, shown, scenes.to_vec(), "evaluate")
        };
        let baseline =
            Baseline::fit(&question, &examples(&self.known)?, BASELINE).map_err(model_error)?;
        let handle = stores.runtime().clone();
        let mut said = |index: usize| -> Result<Vec<f32>, Unreadable> {
            let found = handle.block_on(there.read(self.scenes[index]))?;
            Ok(values(found, target))
        };
        let mut tell_of = |scene: usize, of: usize| {
            control.say(format!("{name}: scene {scene}/{of}"), &[]);
            control.at(scene as f32 / of as f32 * 0.99)
        };
        let scenes = examples(&self.scenes)?;
        let answered = answered_by(&question, &mut said, &baseline, &scenes, &mut tell_of)
            .map_err(model_error)?
            .ok_or(TaskError::Stopped)?;
        let metrics = metrics(&Evaluated::from_scenes(target, &answered), &self.scenes);
        info!("{name}: {}", summary(&metrics));
        let made = Evaluation {
            key,
            model: model.name,
            model_sha256: model.manifest_sha256,
            predicts: target.name().to_owned(),
            dataset: self.task.source.dataset.clone(),
            data: self.data.id.clone(),
            split: self.split.clone(),
            side: settings.side.clone(),
            scenes: self.scenes.len() as u64,
            histogram: histogram.name().to_owned(),
            sensor: false,
            times: String::new(),
            code: settings.version.clone(),
            metrics,
        };
        stores.patiently(control, async || there.put_evaluation(&made).await)?;
        tell(&name, target, &made);
        Ok((made, true))
    }
}

/// Returns a scene's predictions of a quantity as numbers: metres, or probabilities.
fn values(found: Predicted, target: Target) -> Vec<f32> {
    let probabilities = |all: Vec<u8>| all.into_iter().map(|p| f32::from(p) / 255.0).collect();
    match target {
        Target::Tof => found.depth_m,
        Target::Shadow => probabilities(found.lit),
        Target::Specular => probabilities(found.specular),
    }
}

/// Logs how predictions compare with the trivial baselines.
fn tell(name: &str, target: Target, found: &Evaluation) {
    let on = format!(
        "{} {} scenes of {}",
        found.scenes, found.side, found.dataset
    );
    let verdict = Verdict::of_evaluation(target.name(), &found.metrics);
    saying(&verdict, &format!("{name} on {on}"));
}
