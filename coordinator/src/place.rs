//! Which worker may take tasks of which job, and how many at once. Pure.

use picofarm_proto::model::{JobSpec, SceneKind};

/// Furniture that every worker makes by itself.
pub const PARAMETRIC: &str = "parametric-1";

/// A lease should hold about this much work: long enough that its overhead vanishes, short enough that little
/// is lost with a worker.
const LEASE_SECONDS: f64 = 45.0;
/// Most tasks in one lease; its marks are written at each commit.
const MOST: u64 = 1024;
/// A lease takes at most this part of an even share of what is left, so that all workers end together.
const SHARE: u64 = 2;

/// What placement knows of a worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Abilities {
    /// Its renderer's version.
    pub renderer: String,
    /// Furniture fingerprints it has.
    pub assets: Vec<String>,
}

/// Whether a worker may run a job's tasks.
///
/// # Errors
/// Why not, in words.
pub fn may_run(spec: &JobSpec, worker: &Abilities) -> Result<(), String> {
    if worker.renderer != spec.render.renderer {
        return Err(format!(
            "the job needs renderer {:?}, the worker has {:?}",
            spec.render.renderer, worker.renderer
        ));
    }
    if let SceneKind::Furnished { assets, .. } = &spec.scenes.kind
        && assets != PARAMETRIC
        && !worker.assets.contains(assets)
    {
        return Err(format!(
            "the job needs furniture {assets:?}, the worker has none of that fingerprint"
        ));
    }
    Ok(())
}

/// Tasks of the next lease: `mean` seconds a task as observed, `pending` tasks waiting in the job, `in_range` in
/// the range at hand, `workers` that may take them. At least 1 and at most `in_range`.
pub fn lease_size(mean: Option<f64>, pending: u64, in_range: u64, workers: u64) -> u64 {
    let wanted = match mean {
        // Casting saturates: very short tasks give MOST.
        Some(seconds) => (LEASE_SECONDS / seconds.max(1e-6)) as u64,
        None => 1,
    };
    let fair = pending.div_ceil(SHARE * workers.max(1));
    wanted.min(fair).min(MOST).clamp(1, in_range.max(1))
}
