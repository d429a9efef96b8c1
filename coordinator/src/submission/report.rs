//! Describes the effect of submitting a draft, as a plan.

use picofarm_catalog::Job;
use picofarm_proto::{ids::JobId, messages::JobPlan};

use super::{check::Findings, draft::Draft};
use crate::core::plan;

/// Creates the plan from the findings for each stage, the job with this spec, and recent jobs. If
/// that job is done and `stands`, the submission returns it and nothing runs.
pub(super) fn plan(
    draft: &Draft,
    findings: &[Findings],
    (existing_job, stands): (Option<JobId>, bool),
    recent: &[Job],
) -> JobPlan {
    let outputs: Vec<_> = findings.iter().map(Findings::outputs).collect();
    let mut plan = plan::plan(&draft.spec, &draft.hash, &outputs, existing_job, recent);
    let stages = plan.stages.iter_mut().zip(&draft.spec.stages);
    for ((planned, stage), (record, found)) in stages.zip(draft.stages().iter().zip(findings)) {
        let words = found.words(stage, &record.set);
        if stands {
            planned.reuse = planned.total;
            planned.run = 0;
            planned.reasons = vec![format!(
                "{} of {} are done by that job",
                planned.total, planned.total
            )];
            planned.reasons.extend(words);
            continue;
        }
        planned.reasons.extend(words);
    }
    plan.reuse = plan.stages.iter().map(|stage| stage.reuse).sum();
    plan.run = plan.stages.iter().map(|stage| stage.run).sum();
    plan
}
