//! Returns which connected workers could run a planned job. Changes nothing.

use picofarm_proto::spec::JobSpec;

use super::{placement, pools::PoolFit, state::Core};

/// Distinct reasons stored for each stage.
const REASONS: usize = 3;

/// The connected workers with regard to a job before it is recorded.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct EligibleWorkers {
    /// Workers with regard to each stage.
    pub stages: Vec<StageWorkers>,
    /// Workers connected to this coordinator.
    pub here: u32,
    /// Workers connected to other coordinators.
    pub elsewhere: u32,
}

/// The connected workers with regard to one stage.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct StageWorkers {
    /// Number of workers that can run the stage's tasks.
    pub able: u32,
    /// Total CPU cores of these workers.
    pub cores: u32,
    /// Distinct reasons why the other workers cannot.
    pub refusals: Vec<String>,
    /// Pools of workers that other programs start.
    pub pools: Vec<PoolFit>,
}

impl Core {
    /// Compares the requirements of a job's stages with the connected workers.
    pub(crate) fn eligible_workers(&self, spec: &JobSpec, now_ms: i64) -> EligibleWorkers {
        let stages = spec.stages.iter().enumerate().map(|(position, stage)| {
            let known = spec.known(position);
            let mut fit = StageWorkers::default();
            for worker in self.workers.values().filter(|worker| !worker.drains) {
                match placement::may_run(stage, &known, &worker.abilities) {
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
            let pools = self.pools.live(now_ms).map(|pool| {
                let fits = placement::may_run(stage, &known, &pool.abilities);
                pool.fit(fits.err())
            });
            fit.pools = pools.collect();
            fit
        });
        EligibleWorkers {
            stages: stages.collect(),
            here: self.workers.count(),
            elsewhere: self.peers.workers(),
        }
    }
}
