//! What callers are judged by: the token file and the client certificate authorities, as last read.
//!
//! Both files are read again every second. While one of them cannot be used, nobody can say who was
//! revoked in it, so after a short grace every caller is refused: UNAVAILABLE, because the caller
//! is not at fault and workers come back.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::{sync::watch, task::JoinHandle};
use tonic::Status;

use super::tokens::{Entry, Tokens};
use crate::health::Health;

/// How long a file may be unusable before every caller is refused. Editors and `kubectl` replace
/// files in several steps.
pub(crate) const GRACE: Duration = Duration::from_secs(5);

/// A file that callers are judged by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Source {
    /// The token file.
    Tokens,
    /// The client certificate authorities.
    Authorities,
}

impl Source {
    fn name(self) -> &'static str {
        match self {
            Self::Tokens => "the token file",
            Self::Authorities => "the client certificate authorities",
        }
    }
}

/// What callers are judged by.
#[derive(Debug, Clone, Default)]
pub(crate) struct Trust {
    /// The token file as last read.
    pub tokens: Arc<Tokens>,
    /// How often the client certificate authorities have changed.
    pub authorities: u64,
    /// A file that cannot be used.
    faults: [bool; 2],
}

impl Trust {
    pub(super) fn new(tokens: Tokens) -> Self {
        Self {
            tokens: Arc::new(tokens),
            ..Self::default()
        }
    }

    /// Refuses everybody while a file cannot be used, and connections from before a change of the
    /// authorities.
    pub(super) fn judge_connection(&self, authorities: u64) -> Result<(), Status> {
        let sources = [Source::Tokens, Source::Authorities];
        if let Some(source) = sources.into_iter().find(|s| self.faults[*s as usize]) {
            return Err(Status::unavailable(format!(
                "this coordinator cannot use {}, so it refuses every caller until it can; its log has the reason",
                source.name()
            )));
        }
        if authorities < self.authorities {
            return Err(Status::unavailable(
                "the client certificate authorities have changed; connect again",
            ));
        }
        Ok(())
    }

    /// Refuses a caller whose entry is no longer there or has changed.
    pub(super) fn judge(&self, entry: Option<&Entry>, authorities: u64) -> Result<(), Status> {
        self.judge_connection(authorities)?;
        match entry {
            Some(entry) if !self.tokens.entries().contains(entry) => {
                Err(Status::unauthenticated(format!(
                    "the token of {:?} was revoked or its roles were changed",
                    entry.name
                )))
            }
            _ => Ok(()),
        }
    }
}

/// Tells everybody who judges callers what a file comes to.
#[derive(Clone)]
pub(crate) struct Judge {
    trust: Arc<watch::Sender<Trust>>,
    health: Arc<Health>,
}

impl Judge {
    pub(super) fn new(trust: Trust, health: Arc<Health>) -> (Self, watch::Receiver<Trust>) {
        let (sender, receiver) = watch::channel(trust);
        let trust = Arc::new(sender);
        (Self { trust, health }, receiver)
    }

    /// Changes what callers are judged by, if `change` returns `true`.
    pub(crate) fn change(&self, change: impl FnOnce(&mut Trust) -> bool) -> bool {
        self.trust.send_if_modified(change)
    }

    /// A file cannot be used (`Some`, with the reason), or can be used again.
    pub(crate) fn fault(&self, source: Source, why: Option<String>) {
        let closed = why.is_some();
        self.health.access(source.name(), why);
        self.trust.send_if_modified(|trust| {
            let fault = &mut trust.faults[source as usize];
            std::mem::replace(fault, closed) != closed
        });
    }
}

/// Follows one file: says when its trouble has lasted too long.
#[derive(Debug, Default)]
pub(crate) struct Trouble {
    since: Option<Instant>,
    /// The reason that was last logged.
    said: String,
    /// Every caller is refused.
    closed: bool,
}

/// What a look at a file means.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Nothing new.
    Same,
    /// The file cannot be used; there is some time left to repair it.
    Warn,
    /// The file could not be used for too long.
    Close,
    /// The file can be used again, after everybody was refused.
    Reopen,
}

impl Trouble {
    /// Whether the last look found the file usable.
    pub(crate) fn is_over(&self) -> bool {
        self.since.is_none()
    }

    /// Judges a look at `now`; `why` is the reason why the file cannot be used.
    pub(crate) fn judge(&mut self, why: Option<&str>, now: Instant) -> Verdict {
        let Some(why) = why else {
            return match std::mem::take(self).closed {
                true => Verdict::Reopen,
                false => Verdict::Same,
            };
        };
        let since = *self.since.get_or_insert(now);
        let new = self.said != why;
        why.clone_into(&mut self.said);
        if now - since >= GRACE {
            return match std::mem::replace(&mut self.closed, true) && !new {
                true => Verdict::Same,
                false => Verdict::Close,
            };
        }
        match new {
            true => Verdict::Warn,
            false => Verdict::Same,
        }
    }
}

/// Reads a file aside, so that a file system that hangs does not keep old rights in force.
pub(crate) struct Reader<T>(Option<JoinHandle<T>>);

impl<T> Default for Reader<T> {
    fn default() -> Self {
        Self(None)
    }
}

impl<T: Send + 'static> Reader<T> {
    /// What `read` returns, or `None` if it takes longer than the grace. The next call waits for
    /// the same reading.
    pub(crate) async fn read(&mut self, read: impl FnOnce() -> T + Send + 'static) -> Option<T> {
        self.read_within(GRACE, read).await
    }

    async fn read_within(
        &mut self,
        within: Duration,
        read: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        let reading = self
            .0
            .get_or_insert_with(|| tokio::task::spawn_blocking(read));
        let ended = tokio::time::timeout(within, reading).await;
        match ended {
            Ok(read) => {
                self.0 = None;
                // A reader that panicked has read nothing.
                read.ok()
            }
            Err(_) => None,
        }
    }
}

/// Why a file that [`Reader::read`] did not read in time cannot be used.
pub(crate) fn too_slow() -> String {
    format!("reading takes more than {} s", GRACE.as_secs())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_may_be_unusable_for_a_moment_and_not_for_longer() {
        let mut trouble = Trouble::default();
        let start = Instant::now();
        let mut look =
            |why: Option<&str>, at: u64| trouble.judge(why, start + Duration::from_secs(at));
        assert_eq!(look(None, 0), Verdict::Same);
        assert_eq!(look(Some("half written"), 1), Verdict::Warn);
        assert_eq!(look(Some("half written"), 2), Verdict::Same);
        assert_eq!(look(None, 3), Verdict::Same);
        assert_eq!(look(Some("no such file"), 10), Verdict::Warn);
        // Another reason is no new beginning.
        assert_eq!(look(Some("not permitted"), 13), Verdict::Warn);
        assert_eq!(look(Some("not permitted"), 15), Verdict::Close);
        assert_eq!(look(Some("not permitted"), 16), Verdict::Same);
        assert_eq!(look(Some("no such file"), 17), Verdict::Close);
        assert_eq!(look(None, 18), Verdict::Reopen);
        assert_eq!(look(None, 19), Verdict::Same);
    }

    #[tokio::test]
    async fn a_file_system_that_hangs_is_not_waited_for() {
        let (go, gone) = std::sync::mpsc::channel::<()>();
        let mut reader = Reader::default();
        let hangs = move || gone.recv().is_ok();
        let soon = Duration::from_millis(20);
        assert_eq!(reader.read_within(soon, hangs).await, None);
        go.send(()).unwrap();
        // The same reading ends.
        assert_eq!(reader.read(|| false).await, Some(true));
    }

    #[test]
    fn nobody_is_let_in_while_a_file_cannot_be_used() {
        let (judge, trust) = Judge::new(Trust::default(), Arc::default());
        assert!(trust.borrow().judge(None, 0).is_ok());
        judge.fault(Source::Tokens, Some("gone".into()));
        let refused = trust.borrow().judge(None, 0).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::Unavailable);
        assert!(refused.message().contains("the token file"), "{refused}");
        let unready = judge.health.ready().unwrap_err();
        assert!(unready.what.contains("the token file"), "{unready}");
        assert_eq!(unready.detail.as_deref(), Some("gone"));
        judge.fault(Source::Tokens, None);
        assert!(trust.borrow().judge(None, 0).is_ok());
        judge.change(|trust| {
            trust.authorities += 1;
            true
        });
        assert!(trust.borrow().judge(None, 0).is_err());
        assert!(trust.borrow().judge(None, 1).is_ok());
    }
}
