//! The data that callers are checked against: the token file and the client certificate
//! authorities, as last read.
//!
//! Both files are read again every second. While one of them cannot be used, revocations in it are
//! unknown. Every caller is therefore refused after a short grace period. The answer is
//! UNAVAILABLE, because the caller is not at fault and workers reconnect.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::{sync::watch, task::JoinHandle};
use tonic::Status;

use super::tokens::{Entry, Tokens};
use crate::observe::health::Health;

/// Time for which a file may be unusable before every caller is refused. Editors and `kubectl`
/// replace files in several steps.
pub(crate) const GRACE: Duration = Duration::from_secs(5);

/// A file that callers are checked against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CredentialFile {
    /// The token file.
    Tokens,
    /// The client certificate authorities.
    Authorities,
}

impl CredentialFile {
    fn name(self) -> &'static str {
        match self {
            Self::Tokens => "the token file",
            Self::Authorities => "the client certificate authorities",
        }
    }
}

/// The data that callers are checked against.
#[derive(Debug, Clone, Default)]
pub(crate) struct Trust {
    /// The token file as last read.
    pub tokens: Arc<Tokens>,
    /// Number of changes of the client certificate authorities.
    pub authorities: u64,
    /// Whether each file is unusable.
    faults: [bool; 2],
}

impl Trust {
    pub(super) fn new(tokens: Tokens) -> Self {
        Self {
            tokens: Arc::new(tokens),
            ..Self::default()
        }
    }

    /// Refuses every caller while a file cannot be used, and connections from before a change of
    /// the authorities.
    pub(super) fn judge_connection(&self, authorities: u64) -> Result<(), Status> {
        let sources = [CredentialFile::Tokens, CredentialFile::Authorities];
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

    fn knows(&self, entry: &Entry) -> bool {
        let now = self.tokens.by_name(&entry.name);
        now.is_some_and(|now| now.gives_access_of(entry))
    }

    /// Refuses a caller with a removed or changed entry.
    pub(super) fn judge(&self, entry: Option<&Entry>, authorities: u64) -> Result<(), Status> {
        self.judge_connection(authorities)?;
        match entry {
            Some(entry) if !self.knows(entry) => Err(Status::unauthenticated(format!(
                "the token of {:?} was revoked or its roles were changed",
                entry.name
            ))),
            _ => Ok(()),
        }
    }
}

/// Publishes the state of a file to all checks of callers.
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

    /// Changes the published data, if `change` returns `true`.
    pub(crate) fn change(&self, change: impl FnOnce(&mut Trust) -> bool) -> bool {
        self.trust.send_if_modified(change)
    }

    /// Records that a file is unusable (`Some`, with the reason), or usable again.
    pub(crate) fn fault(&self, source: CredentialFile, why: Option<String>) {
        let closed = why.is_some();
        self.health.access(source.name(), why);
        self.trust.send_if_modified(|trust| {
            let fault = &mut trust.faults[source as usize];
            std::mem::replace(fault, closed) != closed
        });
    }
}

/// Follows one file and reports when it has been unusable for too long.
#[derive(Debug, Default)]
pub(crate) struct FileTrouble {
    since: Option<Instant>,
    /// The last logged reason.
    said: String,
    /// Whether every caller is refused.
    closed: bool,
}

/// The consequence of a check of a file.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum FileVerdict {
    /// No change.
    Same,
    /// The file cannot be used, but the grace period has not passed.
    Warn,
    /// The file could not be used for too long.
    Close,
    /// The file can be used again, after every caller was refused.
    Reopen,
}

impl FileTrouble {
    /// Returns whether the last check found the file usable.
    pub(crate) fn is_over(&self) -> bool {
        self.since.is_none()
    }

    /// Evaluates a check at `now`; `why` is the reason why the file cannot be used.
    pub(crate) fn judge(&mut self, why: Option<&str>, now: Instant) -> FileVerdict {
        let Some(why) = why else {
            return match std::mem::take(self).closed {
                true => FileVerdict::Reopen,
                false => FileVerdict::Same,
            };
        };
        let since = *self.since.get_or_insert(now);
        let new = self.said != why;
        why.clone_into(&mut self.said);
        if now - since >= GRACE {
            return match std::mem::replace(&mut self.closed, true) && !new {
                true => FileVerdict::Same,
                false => FileVerdict::Close,
            };
        }
        match new {
            true => FileVerdict::Warn,
            false => FileVerdict::Same,
        }
    }
}

/// Reads a file on a separate thread, so that a file system that hangs does not keep old rights in
/// force.
pub(crate) struct Reader<T>(Option<JoinHandle<T>>);

impl<T> Default for Reader<T> {
    fn default() -> Self {
        Self(None)
    }
}

impl<T: Send + 'static> Reader<T> {
    /// Returns the result of `read`, or `None` if it takes longer than the grace period. The next
    /// call waits for the same read.
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

/// Returns the reason why a file that [`Reader::read`] did not read in time cannot be used.
pub(crate) fn too_slow() -> String {
    format!("reading takes more than {} s", GRACE.as_secs())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_may_be_unusable_for_a_moment_and_not_for_longer() {
        let mut trouble = FileTrouble::default();
        let start = Instant::now();
        let mut look =
            |why: Option<&str>, at: u64| trouble.judge(why, start + Duration::from_secs(at));
        assert_eq!(look(None, 0), FileVerdict::Same);
        assert_eq!(look(Some("half written"), 1), FileVerdict::Warn);
        assert_eq!(look(Some("half written"), 2), FileVerdict::Same);
        assert_eq!(look(None, 3), FileVerdict::Same);
        assert_eq!(look(Some("no such file"), 10), FileVerdict::Warn);
        // Another reason does not restart the grace period.
        assert_eq!(look(Some("not permitted"), 13), FileVerdict::Warn);
        assert_eq!(look(Some("not permitted"), 15), FileVerdict::Close);
        assert_eq!(look(Some("not permitted"), 16), FileVerdict::Same);
        assert_eq!(look(Some("no such file"), 17), FileVerdict::Close);
        assert_eq!(look(None, 18), FileVerdict::Reopen);
        assert_eq!(look(None, 19), FileVerdict::Same);
    }

    #[tokio::test]
    async fn a_file_system_that_hangs_is_not_waited_for() {
        let (go, gone) = std::sync::mpsc::channel::<()>();
        let mut reader = Reader::default();
        let hangs = move || gone.recv().is_ok();
        let soon = Duration::from_millis(20);
        assert_eq!(reader.read_within(soon, hangs).await, None);
        go.send(()).unwrap();
        // The same read ends.
        assert_eq!(reader.read(|| false).await, Some(true));
    }

    #[test]
    fn nobody_is_let_in_while_a_file_cannot_be_used() {
        let (judge, trust) = Judge::new(Trust::default(), Arc::default());
        assert!(trust.borrow().judge(None, 0).is_ok());
        judge.fault(CredentialFile::Tokens, Some("gone".into()));
        let refused = trust.borrow().judge(None, 0).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::Unavailable);
        assert!(refused.message().contains("the token file"), "{refused}");
        let unready = judge.health.ready().unwrap_err();
        assert!(unready.what.contains("the token file"), "{unready}");
        assert_eq!(unready.detail.as_deref(), Some("gone"));
        judge.fault(CredentialFile::Tokens, None);
        assert!(trust.borrow().judge(None, 0).is_ok());
        judge.change(|trust| {
            trust.authorities += 1;
            true
        });
        assert!(trust.borrow().judge(None, 0).is_err());
        assert!(trust.borrow().judge(None, 1).is_ok());
    }
}
