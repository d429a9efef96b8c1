//! How good a model is on scenes, beside what needs no model: masks that are all 1, and the best depth that is the same
//! everywhere.

use burn::tensor::Device;
use picofarm_model::{
    ModelError,
    input::{Batch, DEPTH_SCALE_M, Task, Visit, example},
    metric::Tally,
    net::Net,
    parameters::Parameters,
    scene::{Scene, Scenes},
    train::predict,
};
use serde_json::{Value, json};

use crate::execute::{
    TaskError,
    train::{Known, device, of_model},
};

/// Steps of depth by which the best constant is found: 1 mm of 4.5 m.
const STEPS: usize = 4_500;

/// The figures of a model on all scenes; with a `guide`, two-bounce times follow from its depths. `tell` is given the
/// scenes done and their number, and says whether to go on.
///
/// # Errors
/// [`TaskError::Stopped`]; those of scenes that cannot be read.
pub(super) fn of(
    model: &Known,
    guide: Option<&Known>,
    scenes: &dyn Scenes,
    tell: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Value, TaskError> {
    let device = device();
    let asked = Asked::new(model, &device)?;
    let guide = guide.map(|guide| Asked::new(guide, &device)).transpose()?;
    let task = model.question.task;
    let (mut found, mut plain) = (Tally::default(), Plain::default());
    for index in 0..scenes.len() {
        let scene = scenes.load(index).map_err(|source| {
            of_model(ModelError::Scene {
                scene: index,
                source,
            })
        })?;
        let depth_m = guide
            .as_ref()
            .map(|guide| guide.depth_m(&scene))
            .transpose()?;
        let visits = match model.question.by_spot() {
            true => model.question.spots,
            false => 1,
        };
        for spot in 0..visits {
            let visit = Visit {
                spot,
                ..Visit::default()
            };
            let (said, truth) = asked.of(&scene, depth_m.as_deref(), visit)?;
            found.add(task, &said, &truth);
            plain.add(task, &truth);
        }
        if !tell(index + 1, scenes.len()) {
            return Err(TaskError::Stopped);
        }
    }
    let mut figures = json!(found.metrics(task));
    match task {
        Task::Tof => figures["constant"] = plain.constant(),
        Task::Shadow | Task::Specular => figures["all"] = json!(plain.all.metrics(task)),
    }
    Ok(figures)
}

/// A network that is asked.
struct Asked<'a> {
    model: &'a Known,
    net: Net,
    parameters: Parameters,
}

impl<'a> Asked<'a> {
    fn new(model: &'a Known, device: &Device) -> Result<Self, TaskError> {
        let (net, parameters) = model.ready(device)?;
        Ok(Self {
            model,
            net,
            parameters,
        })
    }

    /// What it says, and what is true.
    fn of(
        &self,
        scene: &Scene,
        depth_m: Option<&[f32]>,
        visit: Visit,
    ) -> Result<(Vec<f32>, Vec<f32>), TaskError> {
        let mut batch = Batch::default();
        example(&mut batch, &self.model.question, scene, depth_m, visit).map_err(of_model)?;
        let said = predict(&self.net, &self.parameters, &batch);
        Ok((said, batch.target))
    }

    fn depth_m(&self, scene: &Scene) -> Result<Vec<f32>, TaskError> {
        let (said, _) = self.of(scene, None, Visit::default())?;
        Ok(said
            .iter()
            .map(|z| z.clamp(0.0, 1.0) * DEPTH_SCALE_M)
            .collect())
    }
}

/// What needs no model.
struct Plain {
    /// Masks that are 1 everywhere.
    all: Tally,
    /// How often each depth is the true one.
    depths: Vec<u64>,
}

impl Default for Plain {
    fn default() -> Self {
        Self {
            all: Tally::default(),
            depths: vec![0; STEPS + 1],
        }
    }
}

impl Plain {
    fn add(&mut self, task: Task, truth: &[f32]) {
        match task {
            Task::Tof => {
                for z in truth {
                    self.depths[(z.clamp(0.0, 1.0) * STEPS as f32).round() as usize] += 1;
                }
            }
            Task::Shadow | Task::Specular => self.all.add(task, &vec![1.0; truth.len()], truth),
        }
    }

    /// The errors of the best constants: the median depth for the mean absolute one, the mean for the other; to 1 mm.
    fn constant(&self) -> Value {
        let metres = |step: usize| step as f64 / STEPS as f64 * f64::from(DEPTH_SCALE_M);
        let each = || {
            self.depths
                .iter()
                .enumerate()
                .map(|(step, n)| (metres(step), *n as f64))
        };
        let pixels = each().map(|(_, n)| n).sum::<f64>().max(1.0);
        let mean = |f: &dyn Fn(f64) -> f64| each().map(|(z, n)| f(z) * n).sum::<f64>() / pixels;
        let mut below = 0.0;
        let median = each().find(|(_, n)| {
            below += n;
            2.0 * below >= pixels
        });
        let (median, middle) = (median.map_or(0.0, |(z, _)| z), mean(&|z| z));
        json!({
            "mae_m": mean(&|z| (z - median).abs()),
            "rmse_m": mean(&|z| (z - middle).powi(2)).sqrt(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_constants_are_the_median_and_the_mean() {
        let mut plain = Plain::default();
        plain.add(Task::Tof, &[0.0, 0.0, 1.0]);
        let found = plain.constant();
        assert!(
            (found["mae_m"].as_f64().unwrap() - 1.5).abs() < 1e-9,
            "{found}"
        );
        let spread = 4.5 * (2.0f64 / 9.0).sqrt();
        assert!(
            (found["rmse_m"].as_f64().unwrap() - spread).abs() < 1e-9,
            "{found}"
        );
    }
}
