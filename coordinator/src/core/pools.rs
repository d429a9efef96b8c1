//! The pools whose programs ask what waits for them. A program that has not asked for a while has
//! ended. Only words depend on pools: whether a job waits in vain.

use std::collections::BTreeMap;

use picofarm_proto::messages::Abilities;

/// A pool is forgotten this long after its program has last asked.
const FORGOTTEN_MS: i64 = 600_000;
/// Most pools that are remembered.
const MOST: usize = 64;

/// The workers that a program can start.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Shape {
    /// Name of the pool. The names of its workers begin with it and a hyphen.
    pub pool: String,
    /// What each worker has.
    pub abilities: Abilities,
    /// How long each worker may run, milliseconds; `None` without a limit.
    pub lasts_ms: Option<u64>,
}

impl Shape {
    /// Returns the pool with regard to a stage that it refuses for this reason, or does not refuse.
    pub(super) fn fit(&self, refused: Option<String>) -> PoolFit {
        PoolFit {
            name: self.pool.clone(),
            refused,
            cores: self.abilities.cores,
            lasts_ms: self.lasts_ms,
        }
    }
}

/// The pools that have asked lately, by name.
#[derive(Default)]
pub(super) struct Pools(BTreeMap<String, (Shape, i64)>);

/// A pool with regard to a stage.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PoolFit {
    /// Name of the pool.
    pub name: String,
    /// Why its workers cannot run the stage's tasks.
    pub refused: Option<String>,
    /// Cores of each worker.
    pub cores: u32,
    /// How long each worker may run, milliseconds; `None` without a limit.
    pub lasts_ms: Option<u64>,
}

impl Pools {
    /// Records that a pool's program has asked.
    pub(super) fn asked(&mut self, shape: &Shape, now_ms: i64) {
        self.0.retain(|_, (_, at)| now_ms - *at < FORGOTTEN_MS);
        if self.0.len() < MOST || self.0.contains_key(&shape.pool) {
            self.0.insert(shape.pool.clone(), (shape.clone(), now_ms));
        }
    }

    /// Returns the pools whose programs run.
    pub(super) fn live(&self, now_ms: i64) -> impl Iterator<Item = &Shape> {
        let live = self.0.values();
        live.filter(move |(_, at)| now_ms - at < FORGOTTEN_MS)
            .map(|(shape, _)| shape)
    }
}
