//! Examinations of the connected workers.

use picofarm_proto::wire::{
    self, session_request::Message as Say, session_response::Message as Heard,
};
use tonic::Code;

use crate::farm::harness::{Farm, Worker, hello, spec};

/// Connects two workers, and waits until the coordinator lists both.
async fn two(farm: &mut Farm) -> (Worker, Worker) {
    let first = farm.connect(hello("first")).await.unwrap();
    let second = farm.connect(hello("second")).await.unwrap();
    loop {
        let list = farm.jobs.list_workers(wire::ListWorkersRequest {}).await;
        if list.unwrap().into_inner().workers.len() == 2 {
            return (first, second);
        }
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
}

fn answer(id: u64, clock_ms: i64, detail: &str) -> Say {
    Say::Examined(wire::Examined {
        id,
        clock_ms,
        checks: vec![wire::Check {
            what: "store".into(),
            verdict: wire::Verdict::Bad.into(),
            detail: detail.into(),
        }],
    })
}

#[tokio::test]
async fn every_worker_is_asked_and_a_silent_one_is_named_in_time() {
    let mut farm = Farm::start().await;
    let (mut first, mut second) = two(&mut farm).await;
    let mut jobs = farm.jobs.clone();
    let asked = tokio::spawn(async move {
        let request = wire::ExamineWorkersRequest {
            store: "/data".into(),
            scenes: "/scenes".into(),
            within_ms: 1_500,
        };
        jobs.examine_workers(request).await
    });
    let ask = match first.hear().await.unwrap() {
        Heard::Examine(ask) => ask,
        other => panic!("expected an examination, heard {other:?}"),
    };
    assert_eq!((&*ask.store, &*ask.scenes), ("/data", "/scenes"));
    assert_eq!(second.hear().await.unwrap(), Heard::Examine(ask.clone()));
    // An answer to an unknown examination and a second answer count for nothing.
    let now = farm.clock.load(std::sync::atomic::Ordering::SeqCst);
    first.say(answer(ask.id + 1, now, "of another")).await;
    first.say(answer(ask.id, now + 5_000, "no space")).await;
    first.say(answer(ask.id, now, "twice")).await;
    let found = asked.await.unwrap().unwrap().into_inner();
    let [one, silent] = &found.workers[..] else {
        panic!("{found:?}");
    };
    assert_eq!(
        (&*one.name, one.answered, one.ahead_ms),
        ("first", true, 5_000)
    );
    assert_eq!(one.checks[0].detail, "no space");
    assert_eq!((&*silent.name, silent.answered), ("second", false));
    assert!(silent.checks.is_empty());
    // A late answer is dropped, and the sessions go on.
    second.say(answer(ask.id, now, "late")).await;
    farm.submit(&spec(2)).await;
    for worker in [&mut first, &mut second] {
        worker.lease().await;
    }
}

#[tokio::test]
async fn nobody_is_asked_without_workers_and_a_location_has_no_control_characters() {
    let mut farm = Farm::start().await;
    let request = wire::ExamineWorkersRequest::default();
    let found = farm.jobs.examine_workers(request).await.unwrap();
    assert!(found.into_inner().workers.is_empty());
    let request = wire::ExamineWorkersRequest {
        store: "/a\n".into(),
        ..wire::ExamineWorkersRequest::default()
    };
    let refused = farm.jobs.examine_workers(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(refused.message().starts_with("store"), "{refused:?}");
}
