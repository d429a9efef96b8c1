//! Batches ahead of the network: one thread reads and prepares what comes next while it learns.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError, mpsc::SyncSender},
};

use super::{Plan, order, run::Position};
use crate::{
    ModelError,
    input::{Batch, Visit, example},
    model::Model,
    scene::{Scene, Scenes},
};

/// Batches that wait for the network.
pub(super) const AHEAD: usize = 2;

/// Depths that a guide keeps: 1 GiB of them.
const MOST_KNOWN: usize = 1 << 28;

/// A depth network that two-bounce times follow from, instead of from the truth.
pub struct Guide {
    model: Arc<Model>,
    known: Mutex<HashMap<usize, Arc<Vec<f32>>>>,
}

impl Guide {
    /// A guide that has looked at nothing yet.
    pub fn new(model: Arc<Model>) -> Self {
        Self {
            model,
            known: Mutex::default(),
        }
    }

    /// Its depths of a scene, metres; asked for once, while there is room to keep them.
    fn depth_m(&self, index: usize, scene: &Scene) -> Result<Arc<Vec<f32>>, ModelError> {
        let lock = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = lock().get(&index) {
            return Ok(Arc::clone(known));
        }
        let depth = Arc::new(self.model.depth_m(scene)?);
        let mut known = lock();
        if (known.len() + 1) * depth.len() <= MOST_KNOWN {
            known.insert(index, Arc::clone(&depth));
        }
        Ok(depth)
    }
}

/// Visits as a batch.
pub(super) fn batch(
    plan: &Plan,
    guide: Option<&Guide>,
    scenes: &dyn Scenes,
    visits: &[(usize, Visit)],
) -> Result<Batch, ModelError> {
    let mut batch = Batch::default();
    for (index, visit) in visits {
        let scene = scenes.load(*index).map_err(|source| ModelError::Scene {
            scene: *index,
            source,
        })?;
        let depth = match guide {
            Some(guide) => Some(guide.depth_m(*index, &scene)?),
            None => None,
        };
        let depth = depth.as_ref().map(|d| d.as_slice());
        example(&mut batch, &plan.question, &scene, depth, *visit)?;
    }
    Ok(batch)
}

/// Prepares the batches from a position on and sends them in order, until nobody listens.
pub(super) fn ahead(
    plan: &Plan,
    guide: Option<&Guide>,
    scenes: &dyn Scenes,
    from: &Position,
    to: &SyncSender<Result<Batch, ModelError>>,
) {
    let mut first = from.batches;
    for epoch in from.epoch..plan.epochs {
        let order = order::epoch(plan.seed, epoch, scenes.len());
        for b in first..plan.batches(scenes.len()) {
            let places = b * plan.batch as u64..(b + 1) * plan.batch as u64;
            let visits: Vec<_> = places
                .map(|at| {
                    let visit = order::visit(plan.seed, epoch, at, &plan.question, plan.augment);
                    (order[at as usize], visit)
                })
                .collect();
            let batch = batch(plan, guide, scenes, &visits);
            let failed = batch.is_err();
            if to.send(batch).is_err() || failed {
                return;
            }
        }
        first = 0;
    }
}
