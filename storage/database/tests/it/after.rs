//! Tests of jobs that begin when others are done, on SQLite and Postgres.

use picofarm_catalog::{
    Catalog, Changes, FormerJob, Job, Outcome, Range, RangeState, Submission, Want,
};
use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::JobState,
};

use crate::listing::{each, job, range, submit};

async fn submit_after(catalog: &dyn Catalog, job: &Job, after: &[JobId]) -> Outcome {
    let (stages, ranges) = (job.stages(), [range(job, 0, 9)]);
    let submission = Submission {
        after,
        ..Submission::new(job, &stages, &ranges, &[])
    };
    catalog.record(&submission).await.unwrap()
}

fn stage(job: &Job) -> StageRef {
    StageRef {
        job: job.id,
        stage: 0,
    }
}

async fn claim(catalog: &dyn Catalog, job: &Job) -> Vec<Range> {
    let want = Want {
        stage: stage(job),
        tasks: 99,
        now_ms: 100,
        force: false,
        suspects: true,
    };
    let claimed = catalog.claim(&[want]).await.unwrap();
    claimed.into_iter().flat_map(|c| c.owned.ranges).collect()
}

async fn finish(catalog: &dyn Catalog, job: &Job, state: RangeState) {
    let mut changes = Changes::default();
    for range in claim(catalog, job).await {
        changes.give(Range {
            state: state.clone(),
            ..range
        });
    }
    changes.perhaps_over.insert(stage(job), 50);
    catalog.commit(&changes).await.unwrap();
}

async fn held(catalog: &dyn Catalog, job: &Job) -> bool {
    catalog.beat(0, 100).await.unwrap().active[&job.id]
}

async fn formers(catalog: &dyn Catalog, job: &Job) -> Vec<FormerJob> {
    catalog.holdups(job.id, 100).await.unwrap().after
}

#[tokio::test]
async fn a_job_begins_when_every_job_before_it_is_done() {
    each(async |catalog| {
        let (a, b, c) = (job(1, "ada"), job(2, "ada"), job(3, "ada"));
        submit(catalog, &a).await;
        submit(catalog, &b).await;
        assert_eq!(submit_after(catalog, &c, &[a.id, b.id]).await, Outcome::New);
        assert!(held(catalog, &c).await && !held(catalog, &a).await);
        assert_eq!(claim(catalog, &c).await, []);
        let record = catalog.job(c.id).await.unwrap().unwrap();
        assert!(!record.job.paused, "a user has not paused it");

        finish(catalog, &a, RangeState::Done { reused: false }).await;
        assert!(held(catalog, &c).await);
        let left = formers(catalog, &c).await;
        let b_is = |state| FormerJob {
            job: b.id,
            number: 2,
            state,
        };
        assert_eq!(left, [b_is(JobState::Active)]);

        // A failed job keeps it waiting, and a retry may still finish that one.
        finish(catalog, &b, RangeState::Dead).await;
        assert_eq!(formers(catalog, &c).await, [b_is(JobState::Failed)]);
        assert_eq!(claim(catalog, &c).await, []);
        assert_eq!(catalog.retry(b.id, 60).await.unwrap(), 9);
        finish(catalog, &b, RangeState::Done { reused: false }).await;
        assert_eq!(formers(catalog, &c).await, []);
        assert!(!held(catalog, &c).await);
        assert_eq!(claim(catalog, &c).await.len(), 1);
    })
    .await;
}

#[tokio::test]
async fn a_job_that_another_waits_for_is_not_forgotten_and_an_unknown_one_is_refused() {
    each(async |catalog| {
        let (a, b) = (job(1, "ada"), job(2, "ada"));
        submit(catalog, &a).await;
        assert_eq!(submit_after(catalog, &b, &[a.id]).await, Outcome::New);
        let unknown = job(9, "ada").id;
        let refused = submit_after(catalog, &job(3, "ada"), &[unknown]).await;
        assert_eq!(refused, Outcome::Changed);
        assert!(catalog.job(job(3, "ada").id).await.unwrap().is_none());

        catalog.cancel(a.id, "by ada", 10).await.unwrap();
        while catalog.forget(1_000).await.unwrap().more {}
        assert_eq!(
            catalog.state(a.id).await.unwrap(),
            Some(JobState::Cancelled)
        );
        assert_eq!(formers(catalog, &b).await[0].state, JobState::Cancelled);
        catalog.cancel(b.id, "by ada", 11).await.unwrap();
        while catalog.forget(1_000).await.unwrap().more {}
        assert_eq!(catalog.state(a.id).await.unwrap(), None);
        assert_eq!(catalog.state(b.id).await.unwrap(), None);
    })
    .await;
}
