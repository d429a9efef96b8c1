//! Jobs that wait for other jobs and for quotas.

use picofarm_catalog::{FormerJob, Holdups};
use picofarm_proto::messages::JobState;

use super::{able, facts, id, job::first};
use crate::{
    core::{Candidate, NotEligible},
    explain::facts::JobFacts,
};

#[test]
fn a_quota_is_the_reason_unless_an_able_worker_is_about_to_get_tasks() {
    let over = Candidate {
        may_run: Err(NotEligible::Quota(
            "jobs of \"ada\" use 60 of at most 64 cores".into(),
        )),
        ..able("b")
    };
    let mut facts = JobFacts {
        candidates: vec![able("a"), over],
        ..facts()
    };
    let (code, words) = first(&facts);
    assert_eq!(code, "quota");
    assert!(
        words.starts_with("10 tasks wait") && words.contains("60 of at most 64 cores"),
        "{words}"
    );
    facts.candidates[0].idle = true;
    assert_eq!(first(&facts).0, "starting");
}

#[test]
fn a_job_after_others_names_each_and_what_can_be_done() {
    let former = |number: u64, state| FormerJob {
        job: id(u128::from(number)),
        number,
        state,
    };
    let facts = JobFacts {
        holdups: Holdups {
            ready: 10,
            after: vec![
                former(3, JobState::Active),
                former(4, JobState::Failed),
                former(5, JobState::Cancelled),
            ],
            ..Holdups::default()
        },
        ..facts()
    };
    let (code, words) = first(&facts);
    assert_eq!(code, "after");
    for part in [
        "job 3 (",
        "which is active",
        "picofarm job retry 4",
        "cancel this job",
    ] {
        assert!(words.contains(part), "{words}");
    }
}
