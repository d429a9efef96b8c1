//! The list of jobs over the wire: paged, latest first, without specs.

use picofarm_proto::{spec::bounds, wire};
use prost::Message;
use tonic::Code;

use crate::farm::harness::{Farm, rendering, spec};

async fn list(
    farm: &mut Farm,
    request: wire::ListJobsRequest,
) -> Result<wire::ListJobsResponse, tonic::Status> {
    Ok(farm.jobs.list_jobs(request).await?.into_inner())
}

#[tokio::test]
async fn jobs_come_in_pages_and_the_answer_says_where_the_next_begins() {
    for mut farm in Farm::start_on_each().await {
        let mut ids = Vec::new();
        for n in 0..5 {
            let mut job = spec(3);
            // The longest allowed name.
            job.name = format!("{n}{}", "x".repeat(bounds::NAME_BYTES - 1));
            rendering(&mut job).output.dataset = format!("d{n}");
            ids.push(farm.submit(&job).await.job_id);
        }
        ids.reverse();
        let mut seen = Vec::new();
        let mut request = wire::ListJobsRequest {
            page_size: 2,
            ..Default::default()
        };
        loop {
            let page = list(&mut farm, request.clone()).await.unwrap();
            assert!(page.jobs.len() <= 2);
            for job in &page.jobs {
                assert!(
                    job.encoded_len() < 1_000,
                    "a thousand of them stay below 1 MB"
                );
                assert_eq!(job.tasks.unwrap().pending, 3);
            }
            seen.extend(page.jobs.into_iter().map(|job| job.id));
            request.page_token = page.next_page_token;
            if request.page_token.is_empty() {
                break;
            }
        }
        assert_eq!(seen, ids);
        let cancel = wire::CancelJobRequest {
            job_id: ids[1].clone(),
        };
        farm.jobs.cancel_job(cancel).await.unwrap();
        let cancelled = wire::ListJobsRequest {
            state: wire::JobState::Cancelled.into(),
            ..Default::default()
        };
        let page = list(&mut farm, cancelled).await.unwrap();
        assert_eq!((page.jobs.len(), &page.jobs[0].id), (1, &ids[1]));
        let found = wire::ListJobsRequest {
            find: ids[2][..30].into(),
            ..Default::default()
        };
        // Ids created at the same time have a common prefix.
        let page = list(&mut farm, found).await.unwrap();
        assert!(page.jobs.iter().any(|job| job.id == ids[2]));
        for (find, id) in [("last", &ids[0]), ("1", ids.last().unwrap())] {
            let request = wire::ListJobsRequest {
                find: find.into(),
                ..Default::default()
            };
            let page = list(&mut farm, request).await.unwrap();
            assert_eq!((page.jobs.len(), &page.jobs[0].id), (1, id), "{find}");
        }
    }
}

#[tokio::test]
async fn a_request_for_a_list_that_makes_no_sense_is_refused_by_its_field() {
    let mut farm = Farm::start().await;
    let any = wire::ListJobsRequest::default;
    for (request, field) in [
        (
            wire::ListJobsRequest {
                page_token: "yesterday".into(),
                ..any()
            },
            "page_token",
        ),
        (wire::ListJobsRequest { state: 77, ..any() }, "state"),
        (
            wire::ListJobsRequest {
                user: "a\0b".into(),
                ..any()
            },
            "user",
        ),
        (
            wire::ListJobsRequest {
                find: "x".repeat(10_000),
                ..any()
            },
            "find",
        ),
    ] {
        let refused = list(&mut farm, request).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{refused:?}");
        assert!(refused.message().starts_with(field), "{refused:?}");
    }
}

#[tokio::test]
#[allow(clippy::needless_update, reason = "some requests have one field alone")]
async fn each_text_of_each_call_is_checked_before_the_catalog_sees_it() {
    for mut farm in Farm::start_on_each().await {
        let jobs = &mut farm.jobs;
        let texts = ["a\0b", "a\u{1b}[2Jb", &"x".repeat(100_000), "\u{202e}"];
        for text in texts.map(str::to_owned) {
            macro_rules! refused {
                ($call:ident, $request:ident, $field:ident) => {{
                    let mut request = wire::$request::default();
                    request.$field = text.clone();
                    let refused = jobs.$call(request).await.unwrap_err();
                    let call = stringify!($call);
                    assert_eq!(refused.code(), Code::InvalidArgument, "{call}: {refused:?}");
                    let field = stringify!($field);
                    assert!(refused.message().starts_with(field), "{call}: {refused:?}");
                    assert!(refused.message().len() < 5_000, "{call}");
                }};
            }
            refused!(get_usage, GetUsageRequest, by);
            refused!(list_audit, ListAuditRequest, who);
            refused!(list_audit, ListAuditRequest, job_id);
            refused!(list_events, ListEventsRequest, job_id);
            refused!(explain_job, ExplainJobRequest, job_id);
            refused!(get_job, GetJobRequest, job_id);
            refused!(watch_job, WatchJobRequest, job_id);
            refused!(cancel_job, CancelJobRequest, job_id);
            refused!(pause_job, PauseJobRequest, job_id);
            refused!(resume_job, ResumeJobRequest, job_id);
            refused!(retry_job, RetryJobRequest, job_id);
            refused!(drain_worker, DrainWorkerRequest, worker);
            refused!(list_jobs, ListJobsRequest, user);
            refused!(list_jobs, ListJobsRequest, find);
            refused!(list_jobs, ListJobsRequest, page_token);
        }
    }
}

#[tokio::test]
async fn a_list_forecasts_the_time_left_of_jobs_with_workers_and_measured_tasks() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(9)).await.job_id;
    let left = async |farm: &mut Farm| {
        let page = list(farm, wire::ListJobsRequest::default()).await.unwrap();
        assert_eq!(page.jobs[0].id, job);
        page.jobs[0].left_s
    };
    assert_eq!(left(&mut farm).await, 0);
    let mut worker = farm.worker().await;
    let first = worker.lease().await;
    let mut done = 0;
    for index in first.lo..first.hi {
        assert!(worker.done(&first, index).await.accepted);
        done += 1;
    }
    worker.lease().await;
    // A task takes 2 s. The catalog counts the tasks that nobody has claimed once a second.
    let start = std::time::Instant::now();
    while left(&mut farm).await != 2 * (9 - done) {
        assert!(start.elapsed().as_secs() < 20, "{}", left(&mut farm).await);
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}
