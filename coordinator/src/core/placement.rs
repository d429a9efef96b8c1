//! Decides which worker may take tasks of each job, and how many at once. Pure.

use picofarm_proto::{
    messages::Abilities,
    spec::{
        SceneKind, StageSpec,
        memory::{Known, gib, peak_bytes},
    },
};

/// Furniture that every worker generates itself.
pub const PARAMETRIC: &str = "parametric-1";

/// Target duration of a lease: long enough that its overhead is negligible, short enough that
/// little is lost with a worker.
const LEASE_SECONDS: f64 = 45.0;
/// Most tasks in one lease, because its marks are written at each commit.
const MOST: u64 = 1024;
/// A lease takes at most this fraction of an even share of the remaining tasks, so that all workers
/// end together.
const SHARE: u64 = 2;

/// Returns the most memory that a stage's task takes on a worker, and the memory available to the
/// worker's tasks, in bytes. Returns `None` if the task fits, or if one of the two is unknown.
pub fn lacks_memory(stage: &StageSpec, known: &Known, worker: &Abilities) -> Option<(u64, u64)> {
    let there = worker.memory_mib << 20;
    let needed = peak_bytes(&stage.task, known, worker.cores)?;
    (there > 0 && needed > there).then_some((needed, there))
}

/// The reason why a worker without an ability gets no task that needs it.
fn lacks(ability: &str) -> String {
    match ability {
        "python" => "the worker runs no Python code of jobs; start one with --python PATH".into(),
        "train:torch" => {
            "the worker trains nothing by PyTorch; start one with --python PATH, of a Python that has PyTorch".into()
        }
        _ => format!("the worker runs no {ability} tasks"),
    }
}

/// Checks whether a worker may run a stage's tasks. `known` contains the known properties of its
/// inputs.
///
/// # Errors
/// Returns the reason why not.
pub fn may_run(stage: &StageSpec, known: &Known, worker: &Abilities) -> Result<(), String> {
    let (kind, version) = (stage.task.kind(), stage.task.version());
    let ability = stage.task.ability();
    match worker.kinds.get(&*ability) {
        None => return Err(lacks(&ability)),
        Some(theirs) if theirs != version => {
            return Err(format!(
                "the job needs {} {version:?}, the worker has {theirs:?}",
                match kind {
                    "render" | "part" => "renderer",
                    other => other,
                }
            ));
        }
        Some(_) => {}
    }
    if let Some(scenes) = stage.task.scenes()
        && let SceneKind::Furnished { assets, .. } = &scenes.kind
        && assets != PARAMETRIC
        && !worker.assets.contains(assets)
    {
        return Err(format!(
            "the job needs furniture {assets:?}, the worker has none of that fingerprint"
        ));
    }
    let needs = &stage.resources;
    if needs.cores > worker.cores {
        return Err(format!(
            "the stage needs {} cores, the worker has {}",
            needs.cores, worker.cores
        ));
    }
    let memory_gib = worker.memory_mib as f64 / 1024.0;
    if needs.memory_gib > memory_gib {
        return Err(format!(
            "the stage needs {} GiB of memory, the worker has {memory_gib:.1}",
            needs.memory_gib
        ));
    }
    if let Some((needed, there)) = lacks_memory(stage, known, worker) {
        return Err(format!(
            "a task takes about {} of memory, the worker's tasks may take {}",
            gib(needed),
            gib(there)
        ));
    }
    if needs.gpus as usize > worker.gpus.len() {
        return Err(format!(
            "the stage needs {} GPUs, the worker has {}",
            needs.gpus,
            worker.gpus.len()
        ));
    }
    if let Some(label) = needs.labels.iter().find(|l| !worker.labels.contains(l)) {
        return Err(format!(
            "the stage needs the label {label:?}, which the worker has not"
        ));
    }
    Ok(())
}

/// Returns the number of tasks in the next lease, from 1 to `in_range`. `mean` is the observed
/// seconds per task, `pending` the waiting tasks of the job, `in_range` the size of the current
/// range, and `workers` the number of workers that may take them.
pub fn lease_size(mean: Option<f64>, pending: u64, in_range: u64, workers: u64) -> u64 {
    let wanted = match mean {
        // The cast saturates: very short tasks give MOST.
        Some(seconds) => (LEASE_SECONDS / seconds.max(1e-6)) as u64,
        None => 1,
    };
    let fair = pending.div_ceil(SHARE * workers.max(1));
    wanted.min(fair).min(MOST).clamp(1, in_range.max(1))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn stage(text: Value) -> StageSpec {
        serde_json::from_value(text).unwrap()
    }

    #[test]
    fn a_worker_is_given_what_not_every_program_does_only_where_it_says_so() {
        let export = |format: &str| {
            stage(json!({
                "kind": "export",
                "source": {"store": "/store", "dataset": "rooms"},
                "export": {"dest": "/out", "format": format},
            }))
        };
        let rooms = |field: Value| {
            stage(json!({
                "kind": "reconstruct",
                "source": {"store": "/store", "dataset": "rooms"},
                "reconstruct": field,
                "output": {"store": "/store", "dataset": "rooms-3d"},
            }))
        };
        let grid = rooms(json!({"version": "r"}));
        let mlp = rooms(json!({"version": "r", "field": "mlp", "mlp": {"steps": 100}}));
        let known = Known::default();
        let mut worker = Abilities {
            cores: 2,
            ..Abilities::default()
        };
        for (plain, special, ability) in [
            (export("zarr"), export("hdf5"), "export:formats"),
            (export("webdataset"), export("sb3d"), "export:formats"),
            (grid, mlp, "reconstruct:mlp"),
        ] {
            let version = plain.task.version().to_owned();
            worker.kinds.clear();
            worker
                .kinds
                .insert(plain.task.kind().into(), version.clone());
            may_run(&plain, &known, &worker).unwrap();
            let why = may_run(&special, &known, &worker).unwrap_err();
            assert_eq!(why, format!("the worker runs no {ability} tasks"));
            worker.kinds.insert(ability.into(), version);
            may_run(&special, &known, &worker).unwrap();
        }
    }
}
