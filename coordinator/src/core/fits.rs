//! Which connected workers could run a job that is planned. Changes nothing.

use picofarm_proto::model::JobSpec;

use super::Core;
use crate::place;

/// Distinct reasons that are kept for each stage.
const REASONS: usize = 3;

/// The connected workers with regard to a job that is not recorded yet.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Fits {
    /// By stage.
    pub stages: Vec<Fit>,
    /// Workers connected to this coordinator.
    pub here: u32,
    /// Workers connected to other coordinators.
    pub elsewhere: u32,
}

/// The connected workers with regard to one stage.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Fit {
    /// How many of them can run its tasks.
    pub able: u32,
    /// CPU cores of those together.
    pub cores: u32,
    /// Why the others cannot, without repetitions.
    pub refusals: Vec<String>,
}

impl Core {
    /// Compares what the stages of a job need with what the connected workers have.
    pub(crate) fn fits(&self, spec: &JobSpec) -> Fits {
        let stages = spec.stages.iter().enumerate().map(|(position, stage)| {
            let known = spec.known(position);
            let mut fit = Fit::default();
            for worker in self.workers.values().filter(|worker| !worker.drains) {
                match place::may_run(stage, &known, &worker.abilities) {
                    Ok(()) => {
                        fit.able += 1;
                        fit.cores = fit.cores.saturating_add(worker.abilities.cores);
                    }
                    Err(why) if fit.refusals.len() < REASONS && !fit.refusals.contains(&why) => {
                        fit.refusals.push(why);
                    }
                    Err(_) => {}
                }
            }
            fit
        });
        Fits {
            stages: stages.collect(),
            here: self.connected(),
            elsewhere: self.elsewhere,
        }
    }
}
