//! Tests of tasks that do not notice a stop request.

use std::{collections::BTreeMap, sync::Mutex, sync::mpsc::Sender};

use picofarm_proto::{
    ids::JobId,
    key::StageKey,
    spec::{JobSpec, StageSpec},
};
use uuid::Uuid;

use super::*;

/// An executor that reports when a task begins, and blocks it until it is released, ignoring its
/// control.
struct Deaf {
    begun: Mutex<Sender<u64>>,
    go: Mutex<Receiver<()>>,
}

impl Executor for Deaf {
    fn kinds(&self) -> BTreeMap<String, String> {
        BTreeMap::new()
    }

    fn assets(&self) -> Vec<String> {
        vec![]
    }

    fn run(&self, task: &Task, _: &Control) -> Result<Output, TaskError> {
        self.begun.lock().unwrap().send(task.index).unwrap();
        self.go.lock().unwrap().recv().unwrap();
        Ok(Output {
            manifest_sha256: String::new(),
            bytes: task.index,
            adopted: false,
        })
    }
}

fn stage(json: &str) -> Arc<StageSpec> {
    let job: JobSpec =
        serde_json::from_str(&format!(r#"{{"name": "t", "stage": [{json}]}}"#)).unwrap();
    Arc::new(job.stages[0].clone())
}

fn task(spec: &Arc<StageSpec>, index: u64) -> Task {
    Task {
        job: JobId::from_uuid(Uuid::from_u128(1)),
        spec: spec.clone(),
        stage: StageKey([0; 32]),
        index,
    }
}

struct Bench {
    runner: Runner,
    begun: Receiver<u64>,
    go: Sender<()>,
}

impl Bench {
    async fn finished(&mut self) -> Ended {
        std::future::poll_fn(|context| self.runner.poll_finished(context)).await
    }
}

fn bench() -> Bench {
    let (begun, heard) = channel();
    let (go, wait) = channel();
    let deaf = Deaf {
        begun: Mutex::new(begun),
        go: Mutex::new(wait),
    };
    let anywhere = StorePrefixes::new(&[]).unwrap();
    Bench {
        runner: Runner::start(Arc::new(deaf), 1, anywhere).unwrap(),
        begun: heard,
        go,
    }
}

const RENDER: &str = r#"{"scenes": {"kind": "primitive", "count": 9}, "render": {"renderer": "r"},
    "output": {"store": "/s", "dataset": "d"}}"#;
const TRAIN: &str = r#"{"kind": "train", "source": {"store": "/s", "dataset": "d"}, "count": 9,
    "train": {"target": "tof", "model": "m"}}"#;

#[tokio::test]
async fn a_task_that_does_not_notice_is_left_and_the_next_one_waits_for_its_end() {
    let mut bench = bench();
    let spec = stage(RENDER);
    let (first, second) = (Arc::new(Control::default()), Arc::new(Control::default()));
    bench
        .runner
        .begin(task(&spec, 1), first.clone(), Span::none());
    assert_eq!(bench.begun.recv(), Ok(1));
    first.stop();
    // The first task is still blocked.
    assert_eq!(bench.finished().await, Err(TaskError::Stopped));
    bench.runner.begin(task(&spec, 2), second, Span::none());
    let early = bench.begun.recv_timeout(Duration::from_millis(200));
    assert_eq!(early, Err(RecvTimeoutError::Timeout));
    bench.go.send(()).unwrap();
    assert_eq!(bench.begun.recv(), Ok(2));
    bench.go.send(()).unwrap();
    assert_eq!(bench.finished().await.map(|o| o.bytes), Ok(2));
}

#[tokio::test]
async fn a_training_may_save_what_it_has_unless_nobody_wants_it() {
    let mut bench = bench();
    let spec = stage(TRAIN);
    let control = Arc::new(Control::default());
    bench
        .runner
        .begin(task(&spec, 1), control.clone(), Span::none());
    assert_eq!(bench.begun.recv(), Ok(1));
    control.stop();
    let waited = tokio::time::timeout(2 * NOTICE, bench.finished()).await;
    assert!(waited.is_err(), "it saves: {waited:?}");
    control.give_up();
    assert_eq!(bench.finished().await, Err(TaskError::Stopped));
    bench.go.send(()).unwrap();
}
