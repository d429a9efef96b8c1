//! The examinations of workers that wait for answers.

use std::{
    collections::HashMap,
    sync::{
        Mutex, MutexGuard,
        atomic::{AtomicU64, Ordering},
    },
};

use picofarm_proto::messages::Examined;
use tokio::sync::mpsc;

use crate::core::SessionId;

/// Answers that may wait to be collected. A worker that sends more waits itself.
const ANSWERS: usize = 64;

/// The session of a worker, its answer, and the coordinator's clock when it arrived.
pub(super) type Answer = (SessionId, Examined, i64);

/// The examinations that wait for answers.
#[derive(Debug, Default)]
pub(crate) struct Examinations {
    next: AtomicU64,
    open: Mutex<HashMap<u64, mpsc::Sender<Answer>>>,
}

impl Examinations {
    /// Opens an examination, until the value is dropped.
    pub(super) fn open(&self) -> OpenExamination<'_> {
        let id = self.next.fetch_add(1, Ordering::Relaxed);
        let (sender, answers) = mpsc::channel(ANSWERS);
        self.locked().insert(id, sender);
        OpenExamination {
            all: self,
            id,
            answers,
        }
    }

    /// Delivers an answer. One that comes too late is dropped.
    pub(super) async fn answered(&self, answer: Answer) {
        let sender = self.locked().get(&answer.1.id).cloned();
        if let Some(sender) = sender {
            // An error means that nobody waits any longer.
            let _ = sender.send(answer).await;
        }
    }

    fn locked(&self) -> MutexGuard<'_, HashMap<u64, mpsc::Sender<Answer>>> {
        self.open.lock().expect("no panic while locked")
    }
}

/// An examination, and its answers.
pub(super) struct OpenExamination<'a> {
    all: &'a Examinations,
    pub id: u64,
    pub answers: mpsc::Receiver<Answer>,
}

impl Drop for OpenExamination<'_> {
    fn drop(&mut self) {
        self.all.locked().remove(&self.id);
    }
}
