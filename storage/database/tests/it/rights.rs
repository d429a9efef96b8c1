//! Tests of the audit log and of job owners, on SQLite and Postgres.

use std::sync::Arc;

use picofarm_catalog::{
    AuditQuery, Catalog, EventQuery, Job, JobQuery, NewAudit, NewEvent, Owner, Sight,
};
use picofarm_database::{PostgresCatalog, SqliteCatalog, testing};
use picofarm_proto::{
    ids::JobId,
    messages::{Act, EventKind, JobState, Outcome},
    spec::JobSpec,
};
use uuid::Uuid;

fn job(n: u128, user: &str, project: &str) -> Job {
    let text = format!(
        r#"{{"name": "n{n}", "project": "{project}", "scenes": {{"kind": "primitive", "count": 1}},
            "output": {{"store": "s", "dataset": "d{n}"}}}}"#
    );
    let spec: JobSpec = serde_json::from_str(&text).unwrap();
    Job {
        id: JobId::from_uuid(Uuid::from_u128(n)),
        spec_hash: format!("h{n}"),
        spec: Arc::new(spec),
        state: JobState::Active,
        submitted_ms: 5,
        ended_ms: None,
        paused: false,
        user: user.into(),
    }
}

fn line(at_ms: i64, who: &str, job: Option<JobId>) -> NewAudit {
    NewAudit {
        at_ms,
        who: who.into(),
        act: Act::Cancel,
        job,
        outcome: Outcome::Refused,
        detail: "it is not yours".into(),
    }
}

async fn the_log_has_its_own_age_and_outlives_jobs(catalog: &dyn Catalog) {
    catalog.load().await.unwrap();
    let job = job(1, "ada", "");
    assert!(catalog.submit(&job, &[], &[]).await.unwrap());
    let lines = [
        line(10, "bob", Some(job.id)),
        line(20, "eve", None),
        line(30, "bob", None),
    ];
    catalog.audit(&lines).await.unwrap();
    catalog.cancel(job.id, "by ada", 40).await.unwrap();
    assert_eq!(catalog.forget(1_000).await.unwrap().jobs, 1);
    let all = AuditQuery {
        limit: 9,
        ..AuditQuery::default()
    };
    let read = catalog.audited(&all).await.unwrap();
    let times: Vec<_> = read.iter().map(|line| line.at_ms).collect();
    assert_eq!(times, [30, 20, 10]);
    assert_eq!(read[2].job, Some(job.id));
    assert_eq!(
        (read[0].act, read[0].outcome),
        (Act::Cancel, Outcome::Refused)
    );
    let of_bob = AuditQuery {
        who: Some("bob".into()),
        before: Some(read[0].sequence),
        ..all.clone()
    };
    assert_eq!(catalog.audited(&of_bob).await.unwrap(), read[2..]);
    let of_job = AuditQuery {
        job: Some(job.id),
        ..all.clone()
    };
    assert_eq!(catalog.audited(&of_job).await.unwrap(), read[2..]);
    assert_eq!(catalog.forget_audit(20).await.unwrap(), 1);
    assert_eq!(catalog.audited(&all).await.unwrap(), read[..2]);
}

async fn readers_see_what_they_may(catalog: &dyn Catalog) {
    catalog.load().await.unwrap();
    // `_` and `%` are not wildcards, and one project's name may be a prefix of another's.
    let jobs = [
        job(1, "ada", ""),
        job(2, "ada", "a_b"),
        job(3, "bob", "aXb"),
        job(4, "eve", "a_bc"),
    ];
    for job in &jobs {
        let event = NewEvent::new(job.id, 5, EventKind::Submitted, "x".into());
        assert!(catalog.submit(job, &[], &[event]).await.unwrap());
        let owner = catalog.owner(job.id).await.unwrap();
        assert_eq!(owner, Some(Owner::from(job)));
    }
    let missing = JobId::from_uuid(Uuid::from_u128(9));
    assert_eq!(catalog.owner(missing).await.unwrap(), None);
    let of = |user: &str, projects: &[&str]| Sight::Of {
        user: user.into(),
        projects: projects.iter().map(|p| (*p).to_owned()).collect(),
    };
    for sight in [
        Sight::All,
        of("ada", &[]),
        of("bob", &["a_b"]),
        of("", &[]),
        of("max", &["a_bc", "aXb"]),
        of("%", &["%", "_"]),
        of("zoe", &[""]),
    ] {
        let seen: Vec<JobId> = jobs
            .iter()
            .filter(|job| sight.sees(&Owner::from(*job)))
            .map(|job| job.id)
            .collect();
        let query = JobQuery {
            sight: sight.clone(),
            limit: 9,
            ..JobQuery::default()
        };
        let listed = catalog.page(&query).await.unwrap().jobs;
        let listed: Vec<_> = listed.into_iter().rev().map(|job| job.id).collect();
        assert_eq!(listed, seen, "{sight:?}");
        let recent = catalog.recent(9, &sight).await.unwrap();
        let recent: Vec<_> = recent.into_iter().rev().map(|job| job.id).collect();
        assert_eq!(recent, seen, "{sight:?}");
        for newest in [false, true] {
            let query = EventQuery {
                job: None,
                after: 0,
                limit: 99,
                task: None,
                stage: None,
                newest,
                logs: true,
                sight: sight.clone(),
            };
            let events = catalog.events(&query).await.unwrap();
            let mut said: Vec<_> = events.into_iter().map(|event| event.job).collect();
            // Each job has a first event and, because it has no tasks, also its end.
            said.dedup();
            assert_eq!(said, seen, "{sight:?}");
        }
    }
}

macro_rules! on_both {
    ($($name:ident),*) => {
        mod sqlite {
            $(#[tokio::test]
            async fn $name() {
                let folder = tempfile::tempdir().unwrap();
                let path = folder.path().join("c.db");
                let catalog = super::SqliteCatalog::open(&path, "test").await.unwrap();
                super::$name(&catalog).await;
            })*
        }
        mod postgres {
            $(#[tokio::test]
            async fn $name() {
                let Some(url) = super::testing::postgres().await else {
                    return;
                };
                let catalog = super::PostgresCatalog::open(&url, "test").await.unwrap();
                super::$name(&catalog).await;
            })*
        }
    };
}
on_both!(
    the_log_has_its_own_age_and_outlives_jobs,
    readers_see_what_they_may
);
