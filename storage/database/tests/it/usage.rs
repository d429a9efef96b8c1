//! Tests of the usage of users, projects and days, on SQLite and Postgres.

use std::sync::Arc;

use picofarm_catalog::{Catalog, Changes, Job, Sight, UsageQuery, day_of};
use picofarm_database::{PostgresCatalog, testing};
use picofarm_proto::{
    ids::JobId,
    messages::{Usage, UsageBy, UsageRow},
};

use crate::listing::{each, job, submit};

fn used(tasks: u64) -> Usage {
    Usage {
        tasks,
        failures: 1,
        core_ms: 1_000 * tasks,
        bytes: 10 * tasks,
    }
}

async fn add(catalog: &dyn Catalog, day: i64, job: JobId, usage: Usage) {
    let changes = Changes {
        usage: [((day, job), usage)].into(),
        ..Changes::default()
    };
    catalog.commit(&changes).await.unwrap();
}

fn query(by: UsageBy) -> UsageQuery {
    UsageQuery {
        by,
        since_day: 0,
        until_day: i64::MAX,
        sight: Sight::All,
    }
}

async fn tasks(catalog: &dyn Catalog, query: &UsageQuery) -> Vec<(String, u64)> {
    let rows = catalog.usage(query).await.unwrap();
    let rows = rows.into_iter().map(|row| (row.name, row.usage.tasks));
    rows.collect()
}

fn rows(of: &[(&str, u64)]) -> Vec<(String, u64)> {
    of.iter()
        .map(|(name, n)| ((*name).to_owned(), *n))
        .collect()
}

fn in_project(job: Job, project: &str) -> Job {
    let mut spec = (*job.spec).clone();
    spec.project = project.into();
    Job {
        spec: Arc::new(spec),
        ..job
    }
}

#[tokio::test]
async fn usage_is_summed_by_user_project_and_day_and_outlives_the_jobs() {
    each(async |catalog| {
        let a = job(1, "ada");
        let b = in_project(job(2, "ada"), "light");
        let c = in_project(job(3, "eve"), "light");
        for job in [&a, &b, &c] {
            submit(catalog, job).await;
        }
        add(catalog, 20_000, a.id, used(1)).await;
        add(catalog, 20_001, a.id, used(2)).await;
        add(catalog, 20_001, b.id, used(4)).await;
        add(catalog, 20_002, c.id, used(8)).await;
        add(catalog, 20_002, c.id, used(16)).await;
        let all = catalog.usage(&query(UsageBy::User)).await.unwrap();
        let eve = UsageRow {
            name: "eve".into(),
            usage: Usage {
                tasks: 24,
                failures: 2,
                core_ms: 24_000,
                bytes: 240,
            },
        };
        assert_eq!(all[1], eve);
        for forgotten in [false, true] {
            if forgotten {
                for job in [&a, &b, &c] {
                    catalog.cancel(job.id, "", 5).await.unwrap();
                }
                while catalog.forget(1_000).await.unwrap().more {}
                assert_eq!(catalog.state(a.id).await.unwrap(), None);
            }
            let by_user = tasks(catalog, &query(UsageBy::User)).await;
            assert_eq!(by_user, rows(&[("ada", 7), ("eve", 24)]));
            let by_project = tasks(catalog, &query(UsageBy::Project)).await;
            assert_eq!(by_project, rows(&[("", 3), ("light", 28)]));
            let by_day = tasks(catalog, &query(UsageBy::Day)).await;
            assert_eq!(by_day, rows(&[("20000", 1), ("20001", 6), ("20002", 24)]));
        }
        let middle = UsageQuery {
            since_day: 20_001,
            until_day: 20_002,
            ..query(UsageBy::User)
        };
        assert_eq!(tasks(catalog, &middle).await, rows(&[("ada", 6)]));
        let of_eve = UsageQuery {
            sight: Sight::Of {
                user: "eve".into(),
                projects: vec![],
            },
            ..query(UsageBy::User)
        };
        assert_eq!(tasks(catalog, &of_eve).await, rows(&[("eve", 24)]));
        let of_light = UsageQuery {
            sight: Sight::Of {
                user: "kim".into(),
                projects: vec!["light".into()],
            },
            ..query(UsageBy::User)
        };
        assert_eq!(
            tasks(catalog, &of_light).await,
            rows(&[("ada", 4), ("eve", 24)])
        );
    })
    .await;
}

#[tokio::test]
async fn impossible_amounts_make_no_sum_overflow() {
    each(async |catalog| {
        let a = job(1, "ada");
        submit(catalog, &a).await;
        let most = Usage {
            tasks: 1,
            failures: 0,
            core_ms: u64::MAX,
            bytes: u64::MAX,
        };
        for _ in 0..3 {
            add(catalog, 20_000, a.id, most).await;
        }
        let rows = catalog.usage(&query(UsageBy::User)).await.unwrap();
        assert_eq!(rows[0].usage.tasks, 3);
        assert!(rows[0].usage.bytes >= 1 << 53);
    })
    .await;
}

#[tokio::test]
async fn two_instances_add_to_one_sum() {
    let Some(url) = testing::postgres().await else {
        return;
    };
    let a = PostgresCatalog::open(&url, "a").await.unwrap();
    let b = PostgresCatalog::open(&url, "b").await.unwrap();
    a.load().await.unwrap();
    b.load().await.unwrap();
    let job = job(1, "ada");
    submit(&a, &job).await;
    tokio::join!(
        add(&a, 20_000, job.id, used(1)),
        add(&b, 20_000, job.id, used(2))
    );
    assert_eq!(tasks(&a, &query(UsageBy::User)).await, rows(&[("ada", 3)]));
}

#[test]
fn a_day_begins_at_midnight_in_utc() {
    assert_eq!([0, 86_399_999, 86_400_000, -1].map(day_of), [0, 0, 1, -1]);
}
