//! Checks the worker's machine when the coordinator asks, while tasks run.

use std::{
    sync::Arc,
    time::{SystemTime, UNIX_EPOCH},
};

use picofarm_proto::messages::{Check, Examine, Examined, Verdict};
use tokio::sync::mpsc;

use crate::{Executor, allow::StorePrefixes};

/// An answer to an examination.
enum Answer {
    Checked(u64, Vec<Check>),
    /// Another examination runs.
    Busy(u64),
}

/// Runs one examination at a time, on a thread of its own.
pub(crate) struct Examiner {
    executor: Arc<dyn Executor>,
    allowed: StorePrefixes,
    running: bool,
    sender: mpsc::UnboundedSender<Answer>,
    answers: mpsc::UnboundedReceiver<Answer>,
}

impl Examiner {
    pub(crate) fn new(executor: Arc<dyn Executor>, allowed: StorePrefixes) -> Self {
        let (sender, answers) = mpsc::unbounded_channel();
        Self {
            executor,
            allowed,
            running: false,
            sender,
            answers,
        }
    }

    /// Begins an examination. It answers at once if the previous one still runs, e.g. because a
    /// file system hangs.
    pub(crate) fn begin(&mut self, what: Examine) {
        let sender = self.sender.clone();
        if self.running {
            // The receiver is in this struct.
            let _ = sender.send(Answer::Busy(what.id));
            return;
        }
        self.running = true;
        let (id, answer) = (what.id, sender.clone());
        let (executor, allowed) = (Arc::clone(&self.executor), self.allowed.clone());
        // Not a thread of the runtime, whose end would wait for a file system that hangs.
        let thread = std::thread::Builder::new().name("examination".into());
        let spawned = thread.spawn(move || {
            let _ = answer.send(Answer::Checked(id, checks(&*executor, &allowed, what)));
        });
        if let Err(e) = spawned {
            let check = Check::new("examination", Verdict::Bad, format!("no thread: {e}"));
            let _ = sender.send(Answer::Checked(id, vec![check]));
        }
    }

    /// Waits for the next answer. Cancel-safe.
    pub(crate) async fn finished(&mut self) -> Examined {
        let answer = self.answers.recv().await.expect("the sender is kept");
        let (id, checks) = match answer {
            Answer::Checked(id, checks) => {
                self.running = false;
                (id, checks)
            }
            Answer::Busy(id) => {
                let what = "the previous examination still runs: a file system or store hangs";
                let check = Check::new("examination", Verdict::Bad, what);
                (id, vec![check])
            }
        };
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        Examined {
            id,
            clock_ms: now.map_or(0, |d| i64::try_from(d.as_millis()).unwrap_or(i64::MAX)),
            checks,
        }
    }
}

/// Runs the checks. A place that the worker may not access is not opened.
fn checks(executor: &dyn Executor, allowed: &StorePrefixes, mut what: Examine) -> Vec<Check> {
    let mut refused = Vec::new();
    for (field, place) in [("store", &mut what.store), ("scenes", &mut what.scenes)] {
        if place.is_empty() {
            continue;
        }
        if let Err(why) = allowed.may_use(field, place) {
            refused.push(Check::new(field, Verdict::Bad, why));
            place.clear();
        }
    }
    let mut checks = executor.examine(&what);
    checks.extend(refused);
    checks
}

#[cfg(test)]
mod tests {
    use std::{
        collections::BTreeMap,
        sync::{Mutex, mpsc::Receiver},
    };

    use super::*;
    use crate::{Control, Output, Task, TaskError};

    /// Repeats the question. It waits until the test lets it go on.
    struct Waits(Mutex<Receiver<()>>);

    impl Executor for Waits {
        fn kinds(&self) -> BTreeMap<String, String> {
            BTreeMap::new()
        }

        fn assets(&self) -> Vec<String> {
            Vec::new()
        }

        fn examine(&self, what: &Examine) -> Vec<Check> {
            self.0.lock().unwrap().recv().unwrap();
            let detail = format!("{:?} {:?}", what.store, what.scenes);
            vec![Check::new("places", Verdict::Ok, detail)]
        }

        fn run(&self, _: &Task, _: &Control) -> Result<Output, TaskError> {
            Err(TaskError::Stopped)
        }
    }

    fn question(id: u64, store: &str) -> Examine {
        Examine {
            id,
            store: store.into(),
            scenes: "/data/scenes".into(),
        }
    }

    #[tokio::test]
    async fn an_examination_opens_only_allowed_places_and_a_second_one_is_answered_at_once() {
        let (go, wait) = std::sync::mpsc::channel();
        let allowed = StorePrefixes::new(&["/data".into()]).unwrap();
        let mut examiner = Examiner::new(Arc::new(Waits(Mutex::new(wait))), allowed);
        examiner.begin(question(1, "/etc"));
        examiner.begin(question(2, "/data"));
        let busy = examiner.finished().await;
        assert_eq!((busy.id, busy.checks[0].verdict), (2, Verdict::Bad));
        go.send(()).unwrap();
        let first = examiner.finished().await;
        assert!(first.id == 1 && first.clock_ms > 0);
        assert_eq!(first.checks[0].detail, "\"\" \"/data/scenes\"");
        assert_eq!(
            (&*first.checks[1].what, first.checks[1].verdict),
            ("store", Verdict::Bad)
        );
        examiner.begin(question(3, "/data/store"));
        go.send(()).unwrap();
        let third = examiner.finished().await;
        assert_eq!((third.id, third.checks.len()), (3, 1));
        assert_eq!(third.checks[0].detail, "\"/data/store\" \"/data/scenes\"");
    }
}
