//! Training by PyTorch: a Python process on this machine has the network and the optimiser, and
//! this worker has everything else. See `python/picofarm/torch/_train.py`.
//!
//! Several processes (`train.processes`) compute the parts of a step's batches in turn, and PyTorch
//! averages their gradients.

use std::collections::BTreeMap;

use picofarm_model::{
    ModelError,
    input::Batch,
    train::{Engine, Pace, Plan},
};
use serde_json::{Value, json};

mod process;
mod rank;
#[cfg(test)]
mod tests;

use process::Processes;
use rank::{Placed, Rank};

use super::TrainingRun;
use crate::{errors::model_error, interpreter::Interpreter, task::TaskError};

/// What a training by PyTorch needs besides its plan.
pub(super) struct Torch<'a> {
    /// The Python interpreter.
    pub(super) python: &'a Interpreter,
    /// The number of processes.
    pub(super) processes: usize,
    /// Whether networks run on graphics processors.
    pub(super) gpus: bool,
    /// Whether the network is compiled before it runs.
    pub(super) compile: bool,
    /// Largest number of bytes of a batch.
    pub(super) batch_bytes: usize,
}

/// A network in Python processes.
pub(super) struct TorchEngine {
    ranks: Vec<Rank>,
    /// The number of batches of a step.
    batches: usize,
    /// The first batch of the next step, which the first process can already read.
    ahead: Option<Placed>,
    /// The versions of Python and PyTorch.
    versions: BTreeMap<String, String>,
    // Dropped last: the processes end when their connections are closed.
    processes: Processes,
}

/// Returns whether an interpreter has PyTorch, without loading it.
pub(crate) fn has_torch(python: &Interpreter) -> bool {
    let asked = "import importlib.util, sys; sys.exit(importlib.util.find_spec('torch') is None)";
    let mut command = std::process::Command::new(python.path());
    let ran = command.args(["-I", "-c", asked]).output();
    ran.is_ok_and(|ran| ran.status.success())
}

impl TrainingRun<'_> {
    /// Starts PyTorch for a plan.
    ///
    /// # Errors
    /// [`TaskError::Crash`] if it does not start.
    pub(super) fn engine(&self, plan: &Plan) -> Result<TorchEngine, TaskError> {
        // The coordinator gives such tasks to workers with Python only.
        let without = "this worker has no Python with PyTorch (--python)";
        let without = || TaskError::Interrupted(without.into());
        let (_, one_hot, outputs) = plan.question.channels();
        let planes = plan.net.dense + one_hot.min(1) + outputs;
        let pixels = self.spec.height as usize * self.spec.width as usize;
        let torch = Torch {
            python: self.python.ok_or_else(without)?,
            processes: self.settings().processes as usize,
            gpus: self.gpu.is_some(),
            compile: self.settings().torch.compile,
            batch_bytes: 4 * plan.batch * planes * pixels,
        };
        torch.start(plan).map_err(model_error)
    }

    /// Describes the runtime for the model's manifest.
    pub(super) fn runtime(&self, engine: &TorchEngine) -> BTreeMap<String, String> {
        let device = if self.gpu.is_some() { "cuda" } else { "cpu" };
        let processes = self.settings().processes.to_string();
        let ours = [
            ("program", "torch"),
            ("device", device),
            ("processes", &processes),
            ("bits", "not repeatable"),
        ];
        let ours = ours.map(|(name, value)| (name.to_owned(), value.to_owned()));
        engine.versions.clone().into_iter().chain(ours).collect()
    }
}

impl Torch<'_> {
    /// Starts the processes of a training.
    ///
    /// # Errors
    /// [`ModelError::Engine`] if they cannot be started or have no PyTorch.
    pub(super) fn start(&self, plan: &Plan) -> Result<TorchEngine, ModelError> {
        let files = 3 * self.processes * self.batch_bytes;
        let mut processes = Processes::start(self.python, self.processes, files as u64)?;
        let (connections, versions) = processes.connect()?;
        let ranks = connections.into_iter().enumerate();
        let ranks = ranks.map(|(number, stream)| Rank::new(number, stream, processes.numbers()));
        let mut engine = TorchEngine {
            ranks: ranks.collect(),
            batches: plan.accumulate,
            ahead: None,
            versions,
            processes,
        };
        let task = json!({
            "plan": plan,
            "gpus": self.gpus,
            "compile": self.compile,
            "channels_last": self.gpus,
        });
        engine.all(&json!({ "do": "begin", "task": task }))?;
        Ok(engine)
    }
}

impl TorchEngine {
    /// Sends a command to all processes, and waits for their answers. Returns the first's.
    fn all(&mut self, command: &Value) -> Result<Value, ModelError> {
        self.send_all(command)?;
        self.settle_all()
    }

    fn send_all(&mut self, command: &Value) -> Result<(), ModelError> {
        let mut ranks = self.ranks.iter_mut();
        ranks
            .try_for_each(|rank| rank.send(command))
            .map_err(|e| self.processes.explain(e))
    }

    /// Waits for all answers. Returns the first process's latest.
    fn settle_all(&mut self) -> Result<Value, ModelError> {
        let answers = self.ranks.iter_mut().map(Rank::settle);
        let answers: Result<Vec<Value>, _> = answers.collect();
        let mut answers = answers.map_err(|e| self.processes.explain(e))?;
        Ok(answers.swap_remove(0))
    }

    /// Sends the batches of a step to the processes in turn.
    fn add(
        &mut self,
        next: &mut dyn FnMut() -> Result<Option<Batch>, ModelError>,
    ) -> Result<(), ModelError> {
        let count = self.ranks.len();
        for at in 0..self.batches {
            let rank = &mut self.ranks[at % count];
            let placed = match self.ahead.take() {
                Some(placed) => placed,
                None => {
                    let batch = next()?.ok_or_else(|| {
                        ModelError::Engine("a step has fewer batches than the plan".into())
                    })?;
                    rank.place(&batch).map_err(|e| self.processes.explain(e))?
                }
            };
            let command = placed.command(
                "add",
                &[("first", at == 0), ("last", at + count >= self.batches)],
            );
            // The process may still compute its previous batch.
            let sent = rank.settle().and_then(|_| rank.send(&command));
            sent.map_err(|e| self.processes.explain(e))?;
        }
        Ok(())
    }
}

impl Engine for TorchEngine {
    fn load(&mut self, state: &[u8], steps: u64) -> Result<(), ModelError> {
        let path = self.processes.folder().join("begin.safetensors");
        std::fs::write(&path, state).map_err(|e| self.processes.unwritten(&path, &e))?;
        self.all(&json!({ "do": "load", "path": path, "steps": steps }))?;
        // A copy of the state takes as much room as a checkpoint.
        std::fs::remove_file(&path).map_err(|e| self.processes.unwritten(&path, &e))
    }

    fn state(&mut self, moments: bool) -> Result<Vec<u8>, ModelError> {
        let path = self.processes.folder().join("state.safetensors");
        let command = json!({ "do": "state", "path": path, "moments": moments });
        let first = &mut self.ranks[0];
        let answered = first.send(&command).and_then(|()| first.settle());
        answered.map_err(|e| self.processes.explain(e))?;
        let state = std::fs::read(&path);
        let removed = std::fs::remove_file(&path);
        let state = state.and_then(|state| removed.map(|()| state));
        state.map_err(|e| self.processes.unwritten(&path, &e))
    }

    fn step(
        &mut self,
        pace: Pace,
        next: &mut dyn FnMut() -> Result<Option<Batch>, ModelError>,
    ) -> Result<f32, ModelError> {
        self.add(next)?;
        let command = json!({
            "do": "step",
            "learning_rate": pace.learning_rate,
            "beta1": pace.beta1,
        });
        self.send_all(&command)?;
        // Copied while the processes compute.
        self.ahead = match next()? {
            Some(batch) => {
                let placed = self.ranks[0].place(&batch);
                Some(placed.map_err(|e| self.processes.explain(e))?)
            }
            None => None,
        };
        let answer = self.settle_all()?;
        // JSON has no number for NaN and infinity.
        Ok(answer["loss"].as_f64().map_or(f32::NAN, |loss| loss as f32))
    }

    fn rewind(&mut self) {
        self.ahead = None;
    }

    fn predict(&mut self, batch: &Batch) -> Result<Vec<f32>, ModelError> {
        let predicted = self.ranks[0].predict(batch);
        predicted.map_err(|e| self.processes.explain(e))
    }
}
