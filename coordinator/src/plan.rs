//! What a job's tasks are and which of them run, given the outputs that exist. Pure.

use picofarm_catalog::{Range, RangeState, Run};
use picofarm_proto::{
    ids::{Epoch, JobId, RangeId, StageRef},
    key::spec_hash,
    model::{JobPlan, JobSpec, SceneKind, SpecError},
};

/// The ranges of a new stage: a done range for each run of existing outputs, a pending one for each gap.
/// `existing` is ascending and disjoint.
pub fn expand(
    stage: StageRef,
    count: u64,
    existing: &[Run],
    ids: &mut dyn FnMut() -> RangeId,
) -> Vec<Range> {
    let mut ranges = Vec::with_capacity(2 * existing.len() + 1);
    let mut push = |lo: u64, hi: u64, state| {
        if lo < hi {
            ranges.push(Range {
                id: ids(),
                stage,
                lo,
                hi,
                epoch: Epoch(0),
                crashes: 0,
                state,
            });
        }
    };
    let mut at = 0;
    for run in existing {
        let (lo, hi) = (run.lo.min(count), run.hi.min(count));
        push(at, lo, RangeState::Pending { not_before_ms: 0 });
        push(lo, hi, RangeState::Done { reused: true });
        at = hi;
    }
    push(at, count, RangeState::Pending { not_before_ms: 0 });
    ranges
}

/// What submitting `spec` would do, given the outputs of exactly these settings and the job that has this spec.
pub fn plan(spec: &JobSpec, existing: &[Run], existing_job: Option<JobId>) -> JobPlan {
    let total = spec.scenes.count;
    let reuse: u64 = existing
        .iter()
        .map(|r| r.hi.min(total) - r.lo.min(total))
        .sum();
    let run = total - reuse;
    let mut reasons = Vec::new();
    if reuse > 0 {
        reasons.push(format!(
            "{reuse} of {total} outputs exist for exactly these scenes and settings: reused"
        ));
    }
    if run > 0 && reuse == 0 {
        reasons.push(format!(
            "{run} tasks run: the catalog has no output for these scenes, render settings and renderer {:?} in data set {:?} of {}",
            spec.render.renderer, spec.output.dataset, spec.output.store
        ));
    } else if run > 0 {
        reasons.push(format!("{run} tasks run: their outputs do not exist yet"));
    }
    if let Some(job) = existing_job {
        reasons.push(format!("job {job} has this exact spec"));
    }
    JobPlan {
        spec_hash: spec_hash(spec),
        total,
        reuse,
        run,
        existing_job,
        reasons,
    }
}

/// The first setting that shapes results and differs between two jobs, in words: `: render.bins is 637 there and
/// 300 here`. `None` where none differs.
pub fn difference(there: &JobSpec, here: &JobSpec) -> Option<String> {
    let shaping = |spec: &JobSpec| {
        let mut scenes = serde_json::to_value(&spec.scenes).expect("settings are plain data");
        scenes["count"] = serde_json::Value::Null;
        serde_json::json!({
            "scenes": scenes, "render": spec.render, "output": {"profile": spec.output.profile},
        })
    };
    let (there, here) = (shaping(there), shaping(here));
    ["scenes", "render", "output"]
        .into_iter()
        .find_map(|section| {
            let (a, b) = (there[section].as_object()?, here[section].as_object()?);
            let name = a.keys().chain(b.keys()).find(|k| a.get(*k) != b.get(*k))?;
            let text =
                |v: Option<&serde_json::Value>| v.map_or("unset".into(), ToString::to_string);
            Some(format!(
                ": {section}.{name} is {} there and {} here",
                text(a.get(name)),
                text(b.get(name))
            ))
        })
}

/// Checks what a client must have resolved before it submits.
///
/// # Errors
/// [`SpecError`] naming the field.
pub fn check_resolved(spec: &JobSpec) -> Result<(), SpecError> {
    if spec.render.renderer.is_empty() {
        return Err(SpecError::new(
            "render.renderer",
            "is empty; the client must fill in the renderer's version before it submits",
        ));
    }
    match &spec.scenes.kind {
        SceneKind::Furnished { assets, .. }
            if matches!(
                assets.as_str(),
                "" | "auto" | "parametric" | "sweethome3d" | "gltf"
            ) =>
        {
            Err(SpecError::new(
                "scenes.assets",
                format!(
                    "{assets:?} is not a fingerprint; the client must resolve it (e.g. to \"parametric-1\") before it submits"
                ),
            ))
        }
        SceneKind::Files { files } => match files.iter().find(|f| f.sha256.len() != 64) {
            Some(file) => Err(SpecError::new(
                "scenes.files",
                format!(
                    "{:?} has no SHA-256; the client must hash each file before it submits",
                    file.path
                ),
            )),
            None => Ok(()),
        },
        _ => Ok(()),
    }
}
