//! The lines of a training's history: losses, and metrics on the validation scenes.

use super::{group::Group, load::Making, position::Line, run::Training};
use crate::{
    ModelError,
    input::Visit,
    metric::{Metrics, Tally},
    model::not_finite,
};

impl Training {
    /// Returns whether an epoch has just ended, or a validation within it is due.
    pub(super) fn line_is_due(&self) -> bool {
        let (step, every) = (self.learner.steps(), self.plan.validate_every);
        let validate =
            every > 0 && step.is_multiple_of(every) && !self.sources.validation.is_empty();
        self.ends_epoch() || (validate && self.position.steps > 0)
    }

    /// Validates if this process leads, or else receives the line from the leading process. Returns
    /// `None` if that process was lost.
    pub(super) fn write_line(
        &mut self,
        group: Option<&mut (dyn Group + '_)>,
    ) -> Result<Option<Line>, ModelError> {
        let line = match group {
            Some(group) if !self.leads => match group.hear(self.learner.digest())? {
                Some(line) => line,
                None => return Ok(None),
            },
            group => {
                let line = self.line()?;
                if let Some(group) = group
                    && !group.is_alone()
                {
                    group.tell(&line, self.learner.digest());
                }
                line
            }
        };
        let validation = line.validation;
        let position = &mut self.position;
        position.history.push(line);
        (position.losses, position.steps) = (0.0, 0);
        if !line.within {
            position.epoch += 1;
            position.batches = 0;
        }
        if let Some(loss) = validation.map(|m| m.loss()) {
            self.judge(loss, line.step)?;
        }
        Ok(Some(line))
    }

    /// Compares a validation with the best one so far.
    fn judge(&mut self, loss: f64, step: u64) -> Result<(), ModelError> {
        let better = self.position.best.is_none_or(|best| loss < best);
        // A NaN or infinite loss is never the best.
        if loss.is_finite() && better {
            self.position.best = Some(loss);
            self.position.since_best = 0;
            if self.plan.early_stop > 0 {
                self.position.kept_step = step;
                self.mirror()?;
                self.kept = Some(self.learner.kept().clone());
            }
        } else {
            self.position.since_best += 1;
        }
        let patience = self.plan.early_stop;
        self.position.stopped_early = patience > 0 && self.position.since_best >= patience;
        Ok(())
    }

    /// Returns the line of the current position, with metrics on the validation scenes.
    fn line(&self) -> Result<Line, ModelError> {
        let validation = match self.sources.validation.is_empty() {
            true => None,
            false => Some(self.validate()?),
        };
        let (position, step) = (&self.position, self.learner.steps());
        Ok(Line {
            epoch: position.epoch + 1,
            within: !self.ends_epoch(),
            step,
            loss: position.losses / position.steps as f64,
            learning_rate: self.pace(step - 1).learning_rate,
            validation,
        })
    }

    /// Returns the metrics on the unmodified validation scenes. The spot of a scene depends only on
    /// the scene's index.
    fn validate(&self) -> Result<Metrics, ModelError> {
        let scenes = &*self.sources.validation;
        let mut tally = Tally::default();
        let question = &self.plan.question;
        let visit = |which: u64| {
            let index = which as usize;
            let spot = match question.by_spot() {
                true => index % question.spots,
                false => 0,
            };
            let visit = Visit {
                spot,
                ..Visit::default()
            };
            (index, visit, None)
        };
        let making = Making {
            plan: &self.plan,
            scenes,
            visit: &visit,
            count: scenes.len() as u64,
            loading: self.loading,
        };
        making.ahead(|ready| {
            for at in 0..scenes.len().div_ceil(self.plan.batch) {
                let batch = ready.next()?;
                let said = self.predict(&batch)?;
                if let Some(odd) = said.iter().position(|value| !value.is_finite()) {
                    let scene = at * self.plan.batch + odd / (said.len() / batch.images.max(1));
                    let step = self.learner.steps();
                    let why = not_finite(&said, odd, &batch, None);
                    let what = format!("validation scene {scene} (counted from 0): {why}");
                    return Err(ModelError::NotFinite { step, what });
                }
                tally.add(question, &said, &batch.target, [batch.height, batch.width]);
            }
            Ok::<(), ModelError>(())
        })?;
        Ok(tally.metrics(self.plan.question.target))
    }
}
