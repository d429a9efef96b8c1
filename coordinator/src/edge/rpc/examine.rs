//! Asks all connected workers to check their machines, and collects their answers.

use std::{
    collections::{HashMap, HashSet},
    time::Duration,
};

use picofarm_proto::{
    messages::{Examine, Examined, ExaminedWorker},
    spec::bounds,
    wire,
};
use tokio::{sync::mpsc, time::Instant};
use tonic::Status;

use super::{examinations::Answer, link::Link};
use crate::{
    actor::Command,
    core::{Asked, AskedWorker, SessionId},
    memory::Account,
};

/// Default and longest time to wait for answers.
const WITHIN: Duration = Duration::from_secs(30);
const LONGEST: Duration = Duration::from_secs(60);
/// Memory of a worker's answer while it is collected and sent.
const WORKER: u64 = 8 << 10;
/// Most bytes of a location.
const PLACE_BYTES: usize = 4096;

/// Asks all workers connected to this coordinator, and waits until each has answered or the time is
/// over.
///
/// # Errors
/// Returns INVALID_ARGUMENT for a location of impossible length, or UNAVAILABLE.
pub(super) async fn examine(
    link: &Link,
    account: &Account,
    request: wire::ExamineWorkersRequest,
) -> Result<wire::ExamineWorkersResponse, Status> {
    let connected = link.ask(Command::Workers).await?;
    let _charge = account
        .charge("the examination", WORKER * u64::from(connected))
        .await?;
    for (field, place) in [("store", &request.store), ("scenes", &request.scenes)] {
        bounds::name(place, PLACE_BYTES)
            .map_err(|what| Status::invalid_argument(format!("{field}: {what}")))?;
    }
    let within = match request.within_ms {
        0 => WITHIN,
        ms => Duration::from_millis(ms.into()).min(LONGEST),
    };
    let mut open = link.examinations.open();
    let what = Examine {
        id: open.id,
        store: request.store,
        scenes: request.scenes,
    };
    let ask = |reply| Command::Examine(what, reply);
    let Asked { workers, elsewhere } = link.ask(ask).await?;
    let answers = collect(&mut open.answers, &workers, within).await;
    let mut workers: Vec<ExaminedWorker> = workers
        .into_iter()
        .map(|worker| result(worker, &answers))
        .collect();
    workers.sort_by(|a, b| (&a.name, &a.id).cmp(&(&b.name, &b.id)));
    Ok(wire::ExamineWorkersResponse {
        workers: workers.into_iter().map(Into::into).collect(),
        elsewhere,
    })
}

/// Collects the first answer of each worker that was asked.
async fn collect(
    answers: &mut mpsc::Receiver<Answer>,
    asked: &[AskedWorker],
    within: Duration,
) -> HashMap<SessionId, (Examined, i64)> {
    let end = Instant::now() + within;
    let mut missing: HashSet<SessionId> = asked.iter().map(|worker| worker.session).collect();
    let mut found = HashMap::new();
    while !missing.is_empty() {
        let Ok(Some((session, examined, at_ms))) =
            tokio::time::timeout_at(end, answers.recv()).await
        else {
            break;
        };
        if missing.remove(&session) {
            found.insert(session, (examined, at_ms));
        }
    }
    found
}

fn result(worker: AskedWorker, answers: &HashMap<SessionId, (Examined, i64)>) -> ExaminedWorker {
    let answer = answers.get(&worker.session);
    ExaminedWorker {
        id: worker.id,
        name: worker.name,
        answered: answer.is_some(),
        ahead_ms: answer.map_or(0, |(examined, at_ms)| {
            examined.clock_ms.saturating_sub(*at_ms)
        }),
        checks: answer.map_or_else(Vec::new, |(examined, _)| examined.checks.clone()),
    }
}
