//! A task's log reaches its coordinator while the task runs, and before its report.

use crate::common;

use common::{Conversation, FakeFarm, Gate, Worker, lease, output};
use picofarm_proto::wire::{self, LogLevel, session_request::Message as Said};
use picofarm_tasks::TaskError;
use tracing::{info, warn};
use tracing_subscriber::prelude::*;

async fn log(c: &mut Conversation) -> wire::TaskLog {
    match c.next().await {
        Some(Said::Log(log)) => log,
        other => panic!("expected lines of a task, got {other:?}"),
    }
}

fn texts(log: &wire::TaskLog) -> Vec<&str> {
    log.lines.iter().map(|line| &*line.text).collect()
}

#[tokio::test]
async fn lines_arrive_while_their_task_runs_and_the_last_ones_before_its_report() {
    tracing_subscriber::registry()
        .with(picofarm_tasks::task_logs())
        .init();
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let worker = Worker::start(farm.address, move |task, control| {
        let index = task.index;
        info!(target: "picofarm_tasks::test", index, "begun");
        info!("somebody else's");
        if index == 0 {
            held.pass(control)?;
        }
        // Logs from every thread of the pool count.
        rayon::join(
            || warn!(target: "picofarm_transient", "left"),
            || warn!(target: "picofarm_transient", "left"),
        );
        match index {
            2 => Err(TaskError::User("no such mesh".into())),
            _ => Ok(output(task)),
        }
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 3)).await;
    let live = log(&mut c).await;
    assert_eq!(live.lease, Some(lease(1, 0, 3).lease.into()));
    assert_eq!((live.index, texts(&live)), (0, vec!["begun index=0"]));
    assert_eq!(live.lines[0].level(), LogLevel::Info);
    gate.open();
    let last = log(&mut c).await;
    assert_eq!((last.index, texts(&last)), (0, vec!["left", "left"]));
    assert_eq!(last.lines[0].level(), LogLevel::Warn);
    let done = c.done().await;
    assert_eq!(done.index, 0);
    c.acknowledge(done.lease, 0).await;
    // The logs of short tasks come with their reports.
    for index in [1, 2] {
        let mut said = Vec::new();
        loop {
            match c.next().await {
                Some(Said::Log(log)) => {
                    assert_eq!(log.index, index);
                    said.extend(log.lines.into_iter().map(|line| line.text));
                }
                Some(Said::Done(done)) => break assert_eq!((done.index, index), (1, 1)),
                Some(Said::Failed(failed)) => break assert_eq!((failed.index, index), (2, 2)),
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(said, [&*format!("begun index={index}"), "left", "left"]);
    }
    drop(c);
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}
