//! Tests of pages of the job list and of deletion, on SQLite and Postgres. The ignored test prints
//! their durations: `cargo test -p picofarm-database --test listing -- --ignored --nocapture`.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_catalog::{
    Catalog, CatalogSource, Changes, Job, JobQuery, NewEvent, Output, Range, RangeState, ResultSet,
};
use picofarm_database::{CatalogPlace, testing};
use picofarm_proto::{
    ids::{Epoch, JobId, RangeId, StageRef},
    messages::{EventKind, JobState},
    spec::JobSpec,
};
use uuid::Uuid;

pub(crate) fn job(n: u128, user: &str) -> Job {
    let spec: JobSpec = serde_json::from_str(&format!(
        r#"{{"name": "job {n}", "scenes": {{"kind": "primitive", "count": 9, "seed": {n}}},
            "render": {{"renderer": "r"}}, "output": {{"store": "s", "dataset": "d"}}}}"#
    ))
    .unwrap();
    Job {
        id: JobId::from_uuid(Uuid::from_u128((n << 64) | n)),
        spec_hash: format!("hash {n}"),
        spec: Arc::new(spec),
        state: JobState::Active,
        submitted_ms: 5,
        ended_ms: None,
        paused: false,
        user: user.into(),
    }
}

pub(crate) fn range(job: &Job, lo: u64, hi: u64) -> Range {
    Range {
        id: RangeId::from_uuid(Uuid::new_v4()),
        stage: StageRef {
            job: job.id,
            stage: 0,
        },
        lo,
        hi,
        epoch: Epoch(0),
        crashes: 0,
        state: RangeState::Pending { not_before_ms: 0 },
    }
}

pub(crate) async fn submit(catalog: &dyn Catalog, job: &Job) {
    let ranges = [range(job, 0, 4), range(job, 4, 9)];
    let event = NewEvent::new(job.id, 5, EventKind::Submitted, "9 tasks".into());
    assert!(catalog.submit(job, &ranges, &[event]).await.unwrap());
}

pub(crate) async fn each(check: impl AsyncFn(&dyn Catalog)) {
    let folder = tempfile::tempdir().unwrap();
    let mut places = vec![CatalogPlace::Sqlite(folder.path().join("c.db"))];
    places.extend(testing::postgres().await.map(CatalogPlace::Postgres));
    for place in places {
        let catalog = place.open("the test").await.unwrap();
        catalog.load().await.unwrap();
        check(catalog.as_ref()).await;
        catalog.close().await;
    }
}

pub(crate) fn query(limit: u32) -> JobQuery {
    JobQuery {
        limit,
        ..JobQuery::default()
    }
}

async fn listed(catalog: &dyn Catalog, query: &JobQuery) -> Vec<String> {
    let page = catalog.page(query).await.unwrap();
    page.jobs.into_iter().map(|job| job.name).collect()
}

#[tokio::test]
async fn pages_hold_every_job_once_the_last_first_and_filters_leave_out_the_others() {
    each(async |catalog| {
        for n in 1..=7 {
            submit(catalog, &job(n, if n % 2 == 0 { "ada" } else { "bob" })).await;
        }
        catalog.cancel(job(2, "").id, "", 9).await.unwrap();
        let active = catalog.active_tasks().await.unwrap();
        assert_eq!((active.total, active.pending), (6 * 9, 6 * 9));
        let mut names = Vec::new();
        let mut next = query(3);
        loop {
            let page = catalog.page(&next).await.unwrap();
            assert!(page.jobs.len() <= 3);
            names.extend(page.jobs.iter().map(|job| job.name.clone()));
            for job in &page.jobs {
                assert_eq!((job.tasks.total, job.tasks.pending), (9, 9), "{job:?}");
                assert_eq!(job.name, format!("job {}", job.number));
            }
            next.before = page.next;
            if page.next.is_none() {
                break;
            }
        }
        let all: Vec<String> = (1..=7).rev().map(|n| format!("job {n}")).collect();
        assert_eq!(names, all);
        let ada = JobQuery {
            user: Some("ada".into()),
            ..query(9)
        };
        assert_eq!(listed(catalog, &ada).await, ["job 6", "job 4", "job 2"]);
        let active = JobQuery {
            state: Some(JobState::Active),
            ..ada
        };
        assert_eq!(listed(catalog, &active).await, ["job 6", "job 4"]);
        let id = job(3, "").id.to_string();
        for text in ["job 3", "3", &id, &id[..20]] {
            let find = JobQuery {
                find: Some(text.into()),
                ..query(9)
            };
            assert_eq!(listed(catalog, &find).await, ["job 3"], "{text}");
        }
    })
    .await;
}

#[tokio::test]
async fn outputs_leave_with_the_last_job_of_their_result_set_and_not_before() {
    each(async |catalog| {
        // The second job shares the first job's results.
        let first = job(1, "ada");
        let mut second = job(2, "ada");
        second.spec = first.spec.clone();
        submit(catalog, &first).await;
        submit(catalog, &second).await;
        let set = ResultSet::of_stage(&first.spec.stages[0]);
        let changes = Changes {
            outputs: vec![Output {
                stage: range(&first, 0, 1).stage,
                task: 3,
                manifest: [1; 32],
                bytes: 7,
                seconds: 1.5,
                epoch: Epoch(1),
                adopted: false,
                checked: false,
            }],
            ..Changes::default()
        };
        catalog.commit(&changes).await.unwrap();
        catalog.cancel(first.id, "", 10).await.unwrap();
        let forget = async || while catalog.forget(100).await.unwrap().more {};
        forget().await;
        assert_eq!(catalog.job(first.id).await.unwrap(), None);
        assert_eq!(catalog.output_runs(&set, 9).await.unwrap().len(), 1);
        catalog.cancel(second.id, "", 20).await.unwrap();
        forget().await;
        assert_eq!(catalog.output_runs(&set, 9).await.unwrap(), []);
        assert_eq!(catalog.page(&query(9)).await.unwrap().jobs, []);
        // Submitted again, the same job is treated like any other.
        submit(catalog, &job(1, "ada")).await;
        assert_eq!(listed(catalog, &query(9)).await, ["job 1"]);
    })
    .await;
}

#[tokio::test]
#[ignore = "prints times"]
async fn times_of_ten_thousand_jobs() {
    const JOBS: u128 = 10_000;
    each(async |catalog| {
        for n in 1..=JOBS {
            submit(catalog, &job(n, "ada")).await;
        }
        let time = async |what: &str, query: JobQuery| {
            let began = Instant::now();
            let page = catalog.page(&query).await.unwrap();
            println!("{what}: {} jobs in {:?}", page.jobs.len(), began.elapsed());
            page.next
        };
        let next = time("first page, active", query(100)).await;
        let second = JobQuery {
            before: next,
            ..query(100)
        };
        time("second page, active", second).await;
        time("a thousand, active", query(1_000)).await;
        for n in 1..=JOBS {
            catalog.cancel(job(n, "").id, "", 10).await.unwrap();
        }
        time("first page, cancelled", query(100)).await;
        let began = Instant::now();
        let (mut jobs, mut longest, mut times) = (0, Duration::ZERO, 0);
        loop {
            let one = Instant::now();
            let forgotten = catalog.forget(100).await.unwrap();
            longest = longest.max(one.elapsed());
            jobs += forgotten.jobs;
            times += 1;
            if !forgotten.more {
                break;
            }
        }
        let rate = f64::from(jobs) / began.elapsed().as_secs_f64();
        println!("forgot {jobs} jobs at {rate:.0} a second; {times} transactions, the longest {longest:?}");
    })
    .await;
}
