//! The tasks that wait for workers of one shape.

use picofarm_proto::{messages::WorkerHello, wire};
use serde::Serialize;

use super::{ANSWER, Client};
use crate::error::Result;

/// The work that waits for the workers of a pool.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Demand {
    /// Stages with waiting tasks, in the order in which they get workers.
    pub stages: Vec<StageDemand>,
    /// Connected workers of the pool.
    pub workers: Vec<PoolWorker>,
    /// Whether some stages may have more tasks than is known.
    pub unknown: bool,
}

/// Waiting tasks of a stage.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct StageDemand {
    /// Id of the job; empty if the caller may not see it.
    pub job: String,
    /// Name of the stage; empty likewise.
    pub stage: String,
    /// Tasks that could be leased now.
    pub tasks: u64,
    /// Expected seconds of a task on one worker, if known.
    pub task_seconds: Option<f64>,
    /// Connected idle workers that may run the tasks.
    pub idle: u32,
    /// How many more workers may join the job; `None` for any number.
    pub room: Option<u32>,
    /// Why a worker of the pool cannot run the tasks; empty if it can.
    pub refused: String,
}

/// A connected worker of a pool.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PoolWorker {
    /// Its name.
    pub name: String,
    /// Unfinished tasks of its leases.
    pub tasks: u64,
}

impl Client {
    /// Returns the tasks that wait for workers such as this one, which has the name of the pool.
    pub async fn demand(&mut self, worker: &WorkerHello) -> Result<Demand> {
        let request = wire::GetDemandRequest {
            worker: Some(worker.clone().into()),
        };
        let reply = self
            .ask(ANSWER, |mut jobs| {
                let request = request.clone();
                async move { jobs.get_demand(request).await }
            })
            .await?;
        let stage = |w: wire::StageDemand| StageDemand {
            job: w.job_id,
            stage: w.stage,
            tasks: w.tasks,
            task_seconds: w.task_seconds,
            idle: w.idle,
            room: w.room,
            refused: w.refused,
        };
        let worker = |w: wire::PoolWorker| PoolWorker {
            name: w.name,
            tasks: w.tasks,
        };
        Ok(Demand {
            stages: reply.stages.into_iter().map(stage).collect(),
            workers: reply.workers.into_iter().map(worker).collect(),
            unknown: reply.unknown,
        })
    }
}
