//! Adds information to a plan that would otherwise appear only after the submission: stages that no
//! connected worker can run, settings that are probably mistakes, and estimates of time and bytes.
//! Pure.

use picofarm_catalog::{Job, ResultSet, Timing};
use picofarm_proto::{
    messages::{Estimate, JobPlan, StagePlan},
    spec::{JobSpec, RenderTask, StageSpec, TaskSpec},
};
use picofarm_settings::Budget;

use crate::core::{EligibleWorkers, StageWorkers, plan::changes, span};

/// Earlier stages with speeds to be looked up, for each stage of a plan.
pub(super) const SIMILAR: usize = 3;
/// Uncertainty of a speed measured with the same settings, as a factor.
const SAME: f64 = 1.5;
/// Uncertainty of a speed measured with other settings and scaled.
const SCALED: f64 = 3.0;
/// Uncertainty of a rule of thumb.
const RULE: f64 = 4.0;
/// CPU-seconds of a furnished room of 256×256 pixels and 25 spots to an error of 10 %
/// (docs/benchmarks.md).
const ROOM_CPU_S: f64 = 24.0;
/// Paths per pixel that such a room takes to that error.
const ROOM_PATHS: f64 = 6.0;
/// Bytes of one bin at rest: 97,432 scenes of 256×256×637 take 1.78 TB (docs/benchmarks.md).
const BIN_BYTES: f64 = 0.44;

/// Returns up to [`SIMILAR`] stages of recent jobs with the same kind of work, most similar first.
pub(super) fn similar<'a>(stage: &StageSpec, recent: &'a [Job]) -> Vec<&'a StageSpec> {
    let same_kind = |other: &&StageSpec| {
        let scenes = |stage: &StageSpec| {
            let scenes = stage.task.scenes();
            scenes.map(|scenes| std::mem::discriminant(&scenes.kind))
        };
        other.task.kind() == stage.task.kind() && scenes(other) == scenes(stage)
    };
    let stages = recent.iter().flat_map(|job| &job.spec.stages);
    let mut found: Vec<(usize, &StageSpec)> = Vec::new();
    for other in stages.filter(same_kind) {
        let set = ResultSet::of_stage(other);
        if found
            .iter()
            .all(|(_, seen)| ResultSet::of_stage(seen) != set)
        {
            found.push((changes(other, stage).len(), other));
        }
    }
    found.sort_by_key(|(changes, _)| *changes);
    found.truncate(SIMILAR);
    found.into_iter().map(|(_, stage)| stage).collect()
}

/// Returns the relative work of one task: pixels times paths for a render, 1 for other kinds.
fn work(stage: &StageSpec) -> f64 {
    match &stage.task {
        TaskSpec::Render(task) => {
            let paths = match task.render.budget {
                Budget::Samples(n) => f64::from(n),
                Budget::Error(e) => ROOM_PATHS * (0.1_f64 / e).powi(2),
            };
            task.render.resolution.pixels() as f64 * paths
        }
        _ => 1.0,
    }
}

/// Returns the relative size of one task's result.
fn size(stage: &StageSpec) -> f64 {
    match &stage.task {
        TaskSpec::Render(task) => {
            task.render.resolution.pixels() as f64 * f64::from(task.render.bins)
        }
        _ => 1.0,
    }
}

/// Estimates for one task: seconds, bytes, and whether they were measured.
type Estimates = (Option<Estimate>, Option<Estimate>, bool);

/// Estimates a stage from the timings of similar stages, most similar first.
pub(super) fn estimate(
    stage: &StageSpec,
    fit: &StageWorkers,
    measured: &[(&StageSpec, Timing)],
) -> Estimates {
    let timed = measured.iter().find(|(_, timing)| timing.tasks > 0);
    if let Some((other, timing)) = timed {
        let same = changes(other, stage).is_empty();
        let spread = if same { SAME } else { SCALED };
        let tasks = timing.tasks as f64;
        let seconds = timing.seconds / tasks * (work(stage) / work(other));
        let bytes = timing.bytes / tasks * (size(stage) / size(other));
        let bytes = (bytes > 0.0).then(|| Estimate::within(bytes, spread));
        return (Some(Estimate::within(seconds, spread)), bytes, true);
    }
    match &stage.task {
        TaskSpec::Render(_) => {
            let room = f64::from(256_u32).powi(2) * ROOM_PATHS;
            let cores = match fit.able {
                0 => {
                    let pools = fit.pools.iter().filter(|pool| pool.refused.is_none());
                    f64::from(pools.map(|pool| pool.cores).max().unwrap_or(1).max(1))
                }
                able => f64::from(fit.cores.max(1)) / f64::from(able),
            };
            let seconds = ROOM_CPU_S * work(stage) / room / cores;
            let bytes = BIN_BYTES * size(stage);
            (
                Some(Estimate::within(seconds, RULE)),
                Some(Estimate::within(bytes, SCALED)),
                false,
            )
        }
        _ => (None, None, false),
    }
}

/// Returns why no worker can run a stage; `None` if one can.
fn unplaceable(fit: &StageWorkers, fits: &EligibleWorkers) -> Option<String> {
    if fit.able > 0 || fit.pools.iter().any(|pool| pool.refused.is_none()) {
        return None;
    }
    let pools = fit.pools.iter().filter_map(|pool| {
        let why = pool.refused.as_ref()?;
        Some(format!("; pool {} starts none: {why}", pool.name))
    });
    let pools: Vec<String> = pools.collect();
    let others = match fits.elsewhere {
        0 => String::new(),
        n => {
            format!(" ({n} more are connected to other coordinators, which this one cannot judge)")
        }
    };
    Some(match fits.here {
        0 if fits.elsewhere > 0 => return None,
        0 => format!(
            "no worker is connected: tasks wait until one is (`picofarm worker --coordinator URL`){}",
            pools.concat()
        ),
        n => format!(
            "{}{others}: {}",
            match n {
                1 => "the only connected worker cannot run its tasks".to_owned(),
                n => format!("none of the {n} connected workers can run its tasks"),
            },
            match fit.refusals.is_empty() {
                true => "all of them are ending".to_owned(),
                false => fit.refusals.join("; "),
            }
        ),
    })
}

/// Returns a warning if a task may take longer than the workers of every able pool run, and no
/// other worker can run it. It names the number of parts with which a scene fits.
fn too_long(stage: &StageSpec, planned: &StagePlan, fit: &StageWorkers) -> Option<String> {
    let able = || fit.pools.iter().filter(|pool| pool.refused.is_none());
    let seconds = planned.task_seconds.filter(|_| !stage.task.resumes())?;
    let longest = able().max_by_key(|pool| pool.lasts_ms.unwrap_or(u64::MAX))?;
    let lasts_s = longest.lasts_ms? as f64 / 1000.0;
    if fit.able > 0 || seconds.high <= lasts_s {
        return None;
    }
    let ms = |seconds: f64| span((seconds * 1000.0) as i64);
    let longer = "start the pool with a longer --time-limit";
    let remedy = match &stage.task {
        TaskSpec::Render(task) if task.parts == 1 => {
            let parts = (seconds.high / lasts_s).ceil() + 1.0;
            let parts = parts.min(f64::from(RenderTask::MAX_PARTS));
            let samples = match task.render.budget {
                Budget::Samples(_) => "",
                Budget::Error(_) => " and `samples` instead of `error`",
            };
            format!("set `parts = {parts}`{samples} in this stage, or {longer}")
        }
        _ => longer.to_owned(),
    };
    Some(format!(
        "a task is expected to take {} to {}, and workers of pool {} run for {}: {remedy}",
        ms(seconds.low),
        ms(seconds.high),
        longest.name,
        ms(lasts_s)
    ))
}

/// Returns the warnings of a plan. Stages with the same warning share a line.
pub(super) fn warnings(spec: &JobSpec, plan: &JobPlan, fits: &EligibleWorkers) -> Vec<String> {
    const NAMED: usize = 3;
    let mut warnings: Vec<(String, Vec<&str>)> = Vec::new();
    let mut add = |what: String, name| match warnings.iter_mut().find(|(known, _)| *known == what) {
        Some((_, names)) => names.push(name),
        None => warnings.push((what, vec![name])),
    };
    for (stage, (planned, fit)) in spec.stages.iter().zip(plan.stages.iter().zip(&fits.stages)) {
        let unplaceable = (planned.run > 0).then(|| unplaceable(fit, fits)).flatten();
        let too_long = (planned.run > 0)
            .then(|| too_long(stage, planned, fit))
            .flatten();
        let about = unplaceable.into_iter().chain(too_long);
        for what in about.chain(stage.task.remarks()) {
            add(what, &stage.name);
        }
    }
    let several = spec.stages.len() > 1;
    let words = warnings.into_iter().map(|(what, names)| {
        let more = match names.len().saturating_sub(NAMED) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        let plural = if names.len() == 1 { "" } else { "s" };
        let shown = names[..names.len().min(NAMED)].join(", ");
        match several {
            true => format!("stage{plural} {shown}{more}: {what}"),
            false => what,
        }
    });
    words.collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::core::PoolFit;

    fn room(resolution: u32, budget: serde_json::Value) -> StageSpec {
        let mut render = json!({"resolution": resolution, "renderer": "r"});
        render
            .as_object_mut()
            .unwrap()
            .extend(budget.as_object().unwrap().clone());
        serde_json::from_value(json!({
            "kind": "render",
            "scenes": {"kind": "primitive", "count": 8},
            "render": render,
            "output": {"store": "/store", "dataset": "rooms"},
        }))
        .unwrap()
    }

    fn fits(able: u32, refusals: &[&str], here: u32, elsewhere: u32) -> EligibleWorkers {
        let refusals = refusals.iter().map(|&why| why.to_owned()).collect();
        let fit = StageWorkers {
            able,
            cores: 4 * able,
            refusals,
            pools: Vec::new(),
        };
        EligibleWorkers {
            stages: vec![fit],
            here,
            elsewhere,
        }
    }

    #[test]
    fn a_measured_speed_is_scaled_by_pixels_and_paths_with_a_wider_range() {
        let fit = StageWorkers::default();
        let timing = Timing {
            tasks: 10,
            seconds: 40.0,
            bytes: 1e6,
        };
        let was = room(64, json!({"samples": 8}));
        let (seconds, bytes, measured) = estimate(&was, &fit, &[(&was, timing)]);
        let (seconds, bytes) = (seconds.unwrap(), bytes.unwrap());
        assert!(measured && seconds.low < 4.0 && seconds.high > 4.0 && seconds.high < 8.0);
        assert!(bytes.low < 1e5 && bytes.high > 1e5);
        let now = room(128, json!({"samples": 16}));
        let (scaled, ..) = estimate(&now, &fit, &[(&was, timing)]);
        let scaled = scaled.unwrap();
        assert!(scaled.low < 32.0 && scaled.high > 32.0);
        assert!(scaled.high / scaled.low > seconds.high / seconds.low);
        // An error of 5 % takes four times the paths of 10 %.
        let error = |e: f64| room(64, json!({ "error": e }));
        let (ten, ..) = estimate(&error(0.1), &fit, &[]);
        let (five, ..) = estimate(&error(0.05), &fit, &[]);
        assert!((five.unwrap().low / ten.unwrap().low - 4.0).abs() < 1e-9);
    }

    #[test]
    fn a_stage_that_no_connected_worker_can_run_is_a_warning_with_the_reason() {
        let stage = room(64, json!({"samples": 8}));
        let spec = JobSpec {
            stages: vec![stage],
            ..serde_json::from_value(json!({
                "name": "n",
                "scenes": {"kind": "primitive", "count": 8},
                "output": {"store": "/store", "dataset": "rooms"},
            }))
            .unwrap()
        };
        let plan = |run| JobPlan {
            spec_hash: String::new(),
            total: 8,
            reuse: 8 - run,
            taken: 0,
            run,
            existing_job: None,
            stages: vec![StagePlan {
                name: spec.stages[0].name.clone(),
                kind: "render".into(),
                total: 8,
                reuse: 8 - run,
                taken: 0,
                run,
                memory_bytes: 0,
                workers: 0,
                task_seconds: None,
                task_bytes: None,
                measured: false,
                reasons: Vec::new(),
            }],
            warnings: Vec::new(),
        };
        let why = "the stage needs 1000 cores, the worker has 2";
        let said = warnings(&spec, &plan(8), &fits(0, &[why], 3, 0));
        assert_eq!(
            said,
            [format!(
                "none of the 3 connected workers can run its tasks: {why}"
            )]
        );
        assert!(
            warnings(&spec, &plan(8), &fits(0, &[], 0, 0))[0].contains("no worker is connected")
        );
        // A pool that can run the tasks starts workers; the reason of another is named.
        let with_pool = |refused: Option<&str>, lasts_s: u64| {
            let mut fits = fits(0, &[], 0, 0);
            fits.stages[0].pools.push(PoolFit {
                name: "gpu".into(),
                refused: refused.map(str::to_owned),
                cores: 8,
                lasts_ms: Some(1000 * lasts_s),
            });
            fits
        };
        assert!(warnings(&spec, &plan(8), &with_pool(None, 60)).is_empty());
        let said = warnings(&spec, &plan(8), &with_pool(Some(why), 60));
        assert!(
            said[0].contains(&format!("pool gpu starts none: {why}")),
            "{said:?}"
        );
        // Scenes longer than its workers run are named, with the number of parts that fit.
        let mut long = plan(8);
        long.stages[0].task_seconds = Some(Estimate {
            low: 90.0,
            high: 360.0,
        });
        let said = warnings(&spec, &long, &with_pool(None, 120));
        assert_eq!(
            said,
            [
                "a task is expected to take 90 s to 6 min, and workers of pool gpu run for 2 min: \
              set `parts = 4` in this stage, or start the pool with a longer --time-limit"
            ]
        );
        assert!(warnings(&spec, &long, &with_pool(None, 400)).is_empty());
        // There is no warning if nothing runs, if one worker can run it, or if only other
        // coordinators know.
        assert!(warnings(&spec, &plan(0), &fits(0, &[why], 3, 0)).is_empty());
        assert!(warnings(&spec, &plan(8), &fits(1, &[why], 3, 0)).is_empty());
        assert!(warnings(&spec, &plan(8), &fits(0, &[], 0, 2)).is_empty());
    }
}
