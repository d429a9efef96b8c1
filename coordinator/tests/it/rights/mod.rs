//! Who may see and change which job, method by method and caller by caller, on both catalogs, and
//! the lines of the audit log.

mod harness;
mod places;

use std::time::{Duration, Instant};

use harness::{CALLERS, Farm, again_soon, begins_anew, catalogs, spec};
use picofarm_coordinator::auth::{METHODS, Needs, Role, Roles, Tokens, Visibility};
use picofarm_proto::wire;
use tonic::Code;

/// A caller's rights to ada's job of the project lidar.
#[derive(Debug, Clone, Copy)]
struct Standing {
    who: &'static str,
    role: Role,
    sees: bool,
    changes: bool,
    /// Whether an equal job that the caller submits is ada's job.
    shares: bool,
}

fn standings(visibility: Visibility) -> impl Iterator<Item = Standing> {
    CALLERS
        .into_iter()
        .map(move |(who, role, member, maintainer)| {
            let admin = role == Role::Admin;
            let changes = admin || who == "ada" || maintainer == "lidar";
            let of_project = member == "lidar" || maintainer == "lidar" || admin;
            Standing {
                who,
                role,
                changes,
                sees: changes
                    || match visibility {
                        Visibility::All => true,
                        Visibility::Project => of_project,
                        Visibility::Own => false,
                    },
                shares: who == "ada" || visibility != Visibility::Own,
            }
        })
}

/// Returns the expected status of a call for callers with a sufficient role.
fn expected(method: &str, standing: Standing) -> Code {
    let (sees, changes) = (standing.sees, standing.changes);
    match method {
        "GetJob" | "GetJobSpec" | "WatchJob" | "ListEvents" | "ExplainJob" if !sees => {
            Code::NotFound
        }
        "CancelJob" | "PauseJob" | "ResumeJob" | "RetryJob" if !sees => Code::NotFound,
        "CancelJob" | "PauseJob" | "ResumeJob" | "RetryJob" if !changes => Code::PermissionDenied,
        // There is no worker.
        "DrainWorker" => Code::NotFound,
        // The caller may not use the project.
        "PlanJob" | "SubmitJob" if !matches!(standing.who, "ada" | "mia" | "max" | "root") => {
            Code::InvalidArgument
        }
        _ => Code::Ok,
    }
}

async fn call(farm: &Farm, method: &str, who: &str, job: &str, name: &str) -> Code {
    let mut jobs = farm.jobs(who);
    let job_id = job.to_owned();
    let shared = Some(spec(name, r#""project": "lidar","#).into());
    macro_rules! code {
        ($call:ident, $request:expr) => {
            jobs.$call($request)
                .await
                .err()
                .map_or(Code::Ok, |status| status.code())
        };
    }
    match method {
        "Session" => farm.session(who).await,
        "GetServerInfo" => code!(get_server_info, wire::GetServerInfoRequest {}),
        "PlanJob" => code!(plan_job, wire::PlanJobRequest { spec: shared }),
        "SubmitJob" => code!(
            submit_job,
            wire::SubmitJobRequest {
                spec: shared,
                again: false
            }
        ),
        "CancelJob" => code!(cancel_job, wire::CancelJobRequest { job_id }),
        "PauseJob" => code!(pause_job, wire::PauseJobRequest { job_id }),
        "ResumeJob" => code!(resume_job, wire::ResumeJobRequest { job_id }),
        "RetryJob" => code!(retry_job, wire::RetryJobRequest { job_id }),
        "ListJobs" => code!(list_jobs, wire::ListJobsRequest::default()),
        "GetJob" => code!(get_job, wire::GetJobRequest { job_id }),
        "GetJobSpec" => code!(get_job_spec, wire::GetJobSpecRequest { job_id }),
        "WatchJob" => code!(watch_job, wire::WatchJobRequest { job_id }),
        "ListEvents" => code!(
            list_events,
            wire::ListEventsRequest {
                job_id,
                ..Default::default()
            }
        ),
        "ExplainJob" => code!(
            explain_job,
            wire::ExplainJobRequest {
                job_id,
                ..Default::default()
            }
        ),
        "ListWorkers" => code!(list_workers, wire::ListWorkersRequest {}),
        "GetDemand" => code!(get_demand, pool("r1")),
        "DrainWorker" => code!(
            drain_worker,
            wire::DrainWorkerRequest {
                worker: "nobody".into()
            }
        ),
        "ExamineWorkers" => code!(examine_workers, wire::ExamineWorkersRequest::default()),
        "GetUsage" => code!(
            get_usage,
            wire::GetUsageRequest {
                by: "user".into(),
                ..Default::default()
            }
        ),
        "ListAudit" => code!(list_audit, wire::ListAuditRequest::default()),
        other => panic!("{other} is new: say here who may call it"),
    }
}

/// Returns the question of a pool of workers with this version of the renderer.
fn pool(renderer: &str) -> wire::GetDemandRequest {
    wire::GetDemandRequest {
        worker: Some(wire::Hello {
            worker_id: uuid::Uuid::new_v4().to_string(),
            incarnation: uuid::Uuid::new_v4().to_string(),
            name: "pool".into(),
            version: "1".into(),
            cores: 1,
            kinds: [("render".to_owned(), renderer.to_owned())].into(),
            ..Default::default()
        }),
    }
}

/// Returns the act recorded for a method.
fn act(method: &str) -> Option<&'static str> {
    Some(match method {
        "SubmitJob" => "submit",
        "CancelJob" => "cancel",
        "PauseJob" => "pause",
        "ResumeJob" => "resume",
        "RetryJob" => "retry",
        "DrainWorker" => "drain",
        _ => return None,
    })
}

#[tokio::test]
async fn each_method_does_for_each_caller_what_it_should_and_acts_are_noted() {
    for visibility in Visibility::ALL {
        let folder = tempfile::tempdir().unwrap();
        for catalog in catalogs(&folder).await {
            let farm = Farm::start(catalog.clone(), visibility).await;
            let mut noted = Vec::new();
            for (path, needs) in METHODS {
                let method = path.rsplit('/').next().unwrap();
                for standing in standings(visibility) {
                    // Each call has its own job, because some calls end it.
                    let name = format!("{method}-{}", standing.who);
                    let of_lidar = spec(&name, r#""project": "lidar","#);
                    let job = farm.submit("ada", &of_lidar, false).await.unwrap().job;
                    noted.push(("ada", "submit", "done"));
                    let allowed = Roles::from(vec![standing.role]).allow(*needs);
                    let wanted = match allowed {
                        true => expected(method, standing),
                        false => Code::PermissionDenied,
                    };
                    let mut got = call(&farm, method, standing.who, &job, &name).await;
                    while begins_anew(got) {
                        again_soon().await;
                        got = call(&farm, method, standing.who, &job, &name).await;
                    }
                    let at = format!(
                        "{method} by {} under {visibility} on {catalog}",
                        standing.who
                    );
                    assert_eq!(got, wanted, "{at}");
                    if let Some(act) = act(method) {
                        let outcome = if wanted == Code::Ok {
                            "done"
                        } else {
                            "refused"
                        };
                        noted.push((standing.who, act, outcome));
                    }
                    assert_eq!(*needs == Needs::Nothing, method == "GetServerInfo");
                }
            }
            let lines = farm.audit().await;
            let lines: Vec<_> = lines
                .iter()
                .filter(|line| line.outcome != "failed")
                .map(|line| (&*line.who, &*line.act, &*line.outcome))
                .collect();
            assert_eq!(lines, noted, "under {visibility} on {catalog}");
            farm.stop().await;
        }
    }
}

#[tokio::test]
async fn lists_and_equal_jobs_show_nobody_what_they_may_not_see() {
    for visibility in Visibility::ALL {
        let folder = tempfile::tempdir().unwrap();
        for catalog in catalogs(&folder).await {
            let farm = Farm::start(catalog, visibility).await;
            let of_lidar = spec("shared", r#""project": "lidar","#);
            let alone = spec("alone", "");
            let job = farm.submit("ada", &of_lidar, false).await.unwrap().job;
            let hers = farm.submit("ada", &alone, false).await.unwrap().job;
            for standing in standings(visibility) {
                let Standing { who, role, .. } = standing;
                if role == Role::Work {
                    continue;
                }
                let mut jobs = farm.jobs(who);
                let list = jobs.list_jobs(wire::ListJobsRequest::default()).await;
                let ids: Vec<_> = list
                    .unwrap()
                    .into_inner()
                    .jobs
                    .into_iter()
                    .map(|j| j.id)
                    .collect();
                assert_eq!(ids.contains(&job), standing.sees, "{who} {visibility}");
                let events = jobs.list_events(wire::ListEventsRequest::default()).await;
                let events = events.unwrap().into_inner().events;
                let said = events.iter().any(|e| e.job_id == job);
                assert_eq!(said, standing.sees, "{who} {visibility}");
                if role == Role::View {
                    continue;
                }
                let all = who == "ada" || visibility == Visibility::All;
                let equal = farm.submit(who, &alone, false).await.unwrap();
                assert_eq!(
                    (equal.existed, equal.job == hers),
                    (all, all),
                    "{who} {visibility}"
                );
                let plan = jobs.plan_job(wire::PlanJobRequest {
                    spec: Some(spec("alone", r#""nonce": "n","#).into()),
                });
                let said = format!("{:?}", plan.await.unwrap());
                let may = all || role == Role::Admin;
                assert!(may || !said.contains(&hers), "{who} {visibility}: {said}");
                if who != "bob" {
                    let equal = farm.submit(who, &of_lidar, false).await.unwrap();
                    assert_eq!(equal.job == job, standing.shares, "{who} {visibility}");
                }
            }
            farm.stop().await;
        }
    }
}

#[tokio::test]
async fn a_pool_learns_how_much_waits_but_not_for_whom_it_may_not_see() {
    for visibility in Visibility::ALL {
        let folder = tempfile::tempdir().unwrap();
        for catalog in catalogs(&folder).await {
            let farm = Farm::start(catalog, visibility).await;
            let of_lidar = spec("shared", r#""project": "lidar","#);
            let job = farm.submit("ada", &of_lidar, false).await.unwrap().job;
            for standing in standings(visibility) {
                let Standing { who, role, .. } = standing;
                if role == Role::Work {
                    continue;
                }
                let mut jobs = farm.jobs(who);
                let demand = loop {
                    let demand = jobs.get_demand(pool("r1")).await.unwrap().into_inner();
                    if !demand.unknown {
                        break demand;
                    }
                    again_soon().await;
                };
                let stages = demand
                    .stages
                    .iter()
                    .map(|s| (&*s.job_id, &*s.stage, s.tasks));
                let (id, stage) = match standing.sees {
                    true => (&*job, "render"),
                    false => ("", ""),
                };
                assert_eq!(
                    stages.collect::<Vec<_>>(),
                    [(id, stage, 2)],
                    "{who} {visibility}"
                );
                let other = jobs.get_demand(pool("r2")).await.unwrap().into_inner();
                let why: Vec<_> = other.stages.iter().map(|s| &*s.refused).collect();
                assert_eq!(
                    why.len(),
                    usize::from(standing.sees),
                    "{who} {visibility}: {why:?}"
                );
                assert!(why.iter().all(|w| w.contains("renderer \"r1\"")), "{why:?}");
            }
            farm.stop().await;
        }
    }
}

#[tokio::test]
async fn nobody_repeats_or_outranks_what_is_not_theirs() {
    let folder = tempfile::tempdir().unwrap();
    for catalog in catalogs(&folder).await {
        let farm = Farm::start(catalog, Visibility::All).await;
        let of_lidar = spec("again", r#""project": "lidar","#);
        let job = farm.submit("ada", &of_lidar, false).await.unwrap().job;
        let cancel = wire::CancelJobRequest {
            job_id: job.clone(),
        };
        farm.jobs("max").cancel_job(cancel).await.unwrap();
        let refused = farm.submit("mia", &of_lidar, true).await.unwrap_err();
        assert_eq!(refused.code(), Code::PermissionDenied);
        let words = [&*job, "\"ada\"", "maintainer of project \"lidar\""];
        assert!(
            words.iter().all(|w| refused.message().contains(w)),
            "{refused}"
        );
        let second = farm.submit("max", &of_lidar, true).await.unwrap();
        assert!(!second.existed && second.job != job);

        let mut forced = of_lidar.clone();
        forced.nonce = "n".into();
        forced.stages[0].force = true;
        // The results are ada's, and the second job's submitter came later.
        let refused = farm.submit("mia", &forced, false).await.unwrap_err();
        assert_eq!(refused.code(), Code::PermissionDenied);
        assert!(refused.message().contains("cannot be forced"), "{refused}");
        farm.submit("max", &forced, false).await.unwrap();

        let high = spec("high", r#""priority": 2147483647,"#);
        let refused = farm.submit("bob", &high, false).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
        let words = ["priority", "-100..=100", "--max-priority"];
        assert!(
            words.iter().all(|w| refused.message().contains(w)),
            "{refused}"
        );
        farm.submit("root", &high, false).await.unwrap();
        farm.stop().await;
    }
}

#[tokio::test]
async fn the_audit_log_outlives_the_coordinator_and_pages_and_notes_new_tokens() {
    let folder = tempfile::tempdir().unwrap();
    for catalog in catalogs(&folder).await {
        let farm = Farm::start(catalog.clone(), Visibility::All).await;
        for i in 0..5 {
            farm.submit("ada", &spec(&format!("j{i}"), ""), false)
                .await
                .unwrap();
        }
        farm.stop().await;
        let farm = Farm::start(catalog, Visibility::All).await;
        let whole = farm.audit().await;
        // A submission was repeated if the coordinator restarted its life; the log then has both.
        let done: Vec<_> = whole.iter().filter(|line| line.outcome == "done").collect();
        assert_eq!(done.len(), 5, "{whole:#?}");
        let mut paged = Vec::new();
        loop {
            let request = wire::ListAuditRequest {
                before: paged
                    .last()
                    .map_or(0, |line: &wire::AuditEntry| line.sequence),
                limit: 2,
                who: "ada".into(),
                ..Default::default()
            };
            let answer = farm.jobs("root").list_audit(request).await.unwrap();
            let page = answer.into_inner().entries;
            if page.is_empty() {
                break;
            }
            paged.extend(page);
        }
        paged.reverse();
        assert_eq!(paged, whole);
        let one = wire::ListAuditRequest {
            job_id: done[2].job_id.clone(),
            ..Default::default()
        };
        let answer = farm.jobs("root").list_audit(one).await.unwrap();
        assert_eq!(
            answer.into_inner().entries.iter().collect::<Vec<_>>(),
            done[2..3]
        );

        let mut tokens = Tokens::read(&farm.tokens).unwrap();
        tokens.revoke("vic");
        tokens
            .create("new", vec![Role::View].into(), vec![], vec![])
            .unwrap();
        tokens.write(&farm.tokens).unwrap();
        let began = Instant::now();
        let line = loop {
            if let Some(line) = farm.audit().await.pop().filter(|line| line.act == "tokens") {
                break line;
            }
            assert!(
                began.elapsed() < Duration::from_secs(20),
                "no line about the token file"
            );
            tokio::time::sleep(Duration::from_millis(50)).await;
        };
        assert_eq!((&*line.who, &*line.outcome), ("(coordinator)", "done"));
        assert_eq!(line.detail, "added: new; removed: vic");
        farm.stop().await;
    }
}
