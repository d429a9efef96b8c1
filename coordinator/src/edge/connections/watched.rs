//! Certificates that change while the coordinator runs. The files are checked like the token file.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_credentials::CredentialError;
use picofarm_proto::messages::{Act, Outcome};
use rustls::ServerConfig;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::{
    auth::{
        CredentialFile, FileTrouble, FileVerdict, GRACE, Judge, Loaded, Reader, TlsFiles, too_slow,
    },
    observe::audit::{Audit, COORDINATOR},
};

/// Interval between checks of the files.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// The result of a check of the files, given the previous check.
#[derive(Debug, PartialEq, Eq)]
enum CheckResult {
    Same,
    New,
    /// The files cannot be used, with the same message twice in a row. Certificate and key are two
    /// files, so that one of them is briefly out of date while they are replaced.
    Unusable(String),
}

/// Compares successive checks.
#[derive(Default)]
struct CheckHistory {
    complaint: String,
    said: bool,
}

impl CheckHistory {
    fn judge(&mut self, now: [u8; 32], read: Result<[u8; 32], &CredentialError>) -> CheckResult {
        match read {
            Ok(new) => {
                *self = Self::default();
                if new == now {
                    CheckResult::Same
                } else {
                    CheckResult::New
                }
            }
            Err(error) => {
                let error = error.to_string();
                if error != self.complaint {
                    (self.complaint, self.said) = (error, false);
                    return CheckResult::Same;
                }
                if std::mem::replace(&mut self.said, true) {
                    return CheckResult::Same;
                }
                CheckResult::Unusable(self.complaint.clone())
            }
        }
    }
}

/// The certificates of new connections.
#[derive(Clone)]
pub(crate) struct Certificates {
    pub config: Arc<ServerConfig>,
    /// Number of changes of the client certificate authorities.
    pub authorities: u64,
}

/// Returns the current certificates, from files that are read again until `stop`.
///
/// If the own certificate cannot be used, nothing changes except for a log line, because the
/// certificate admits nobody. Connections keep the certificates with which they began. Changed
/// client certificate authorities that are not in force could admit a revoked client. If they
/// cannot be used within [`GRACE`], every caller is refused. After a change, callers on older
/// connections are refused, and reconnect with a certificate to be checked again.
pub(crate) fn follow(
    files: TlsFiles,
    loaded: Loaded,
    judge: Judge,
    audit: Audit,
    stop: CancellationToken,
) -> watch::Receiver<Certificates> {
    let (sender, receiver) = watch::channel(Certificates {
        config: loaded.config,
        authorities: 0,
    });
    let (mut now, mut authorities) = (loaded.digest, loaded.authorities);
    tokio::spawn(async move {
        let (mut checks, mut trouble) = (CheckHistory::default(), FileTrouble::default());
        let mut reader = Reader::default();
        loop {
            tokio::select! {
                () = tokio::time::sleep(CHECK_INTERVAL) => {}
                () = stop.cancelled() => return,
            }
            let aside = files.clone();
            let look = move || {
                let same = aside.has_authorities(&authorities);
                (aside.read(), same)
            };
            let (read, same) = reader.read(look).await.unwrap_or_else(|| {
                let slow = CredentialError::Unusable {
                    path: files.certificate.clone(),
                    what: too_slow(),
                };
                (Err(slow), files.client_ca.is_none())
            });
            let unknown = read.as_ref().err().filter(|_| !same);
            let unknown = unknown.map(ToString::to_string);
            match trouble.judge(unknown.as_deref(), Instant::now()) {
                FileVerdict::Warn => tracing::error!(
                    "{}; every caller is refused unless this is repaired within {} s",
                    unknown.unwrap_or_default(),
                    GRACE.as_secs()
                ),
                FileVerdict::Close => {
                    let why = unknown.unwrap_or_default();
                    tracing::error!("{why}; every caller is refused until this is repaired");
                    let line = format!("every caller is refused: {why}");
                    audit.note(COORDINATOR, Act::Certificates, Outcome::Failed, &line);
                    judge.fault(CredentialFile::Authorities, Some(why));
                }
                FileVerdict::Same | FileVerdict::Reopen => {}
            }
            match checks.judge(now, read.as_ref().map(|loaded| loaded.digest)) {
                CheckResult::Same => {}
                CheckResult::New => {
                    let loaded = read.expect("files that cannot be read are not new");
                    now = loaded.digest;
                    let changed = loaded.authorities != authorities;
                    authorities = loaded.authorities;
                    let count = sender.borrow().authorities + u64::from(changed);
                    sender.send_replace(Certificates {
                        config: loaded.config,
                        authorities: count,
                    });
                    judge.change(|trust| {
                        trust.authorities = count;
                        changed
                    });
                    tracing::info!(certificate = %files.certificate.display(), "the certificates were read again");
                    audit.note(COORDINATOR, Act::Certificates, Outcome::Done, &loaded.about);
                }
                CheckResult::Unusable(why) => {
                    if same {
                        tracing::error!("{why}; the certificates read before stay in force");
                    }
                    audit.note(COORDINATOR, Act::Certificates, Outcome::Failed, &why);
                }
            }
            if trouble.is_over() {
                judge.fault(CredentialFile::Authorities, None);
            }
        }
    });
    receiver
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_in_the_middle_of_being_replaced_is_no_complaint_and_a_bad_one_is_one() {
        let bad = |what: &str| CredentialError::Unusable {
            path: "c.pem".into(),
            what: what.into(),
        };
        let mut checks = CheckHistory::default();
        assert_eq!(checks.judge([1; 32], Ok([1; 32])), CheckResult::Same);
        assert_eq!(
            checks.judge([1; 32], Err(&bad("does not match"))),
            CheckResult::Same
        );
        assert_eq!(checks.judge([1; 32], Ok([2; 32])), CheckResult::New);
        assert_eq!(
            checks.judge([2; 32], Err(&bad("is no PEM"))),
            CheckResult::Same
        );
        let seen = checks.judge([2; 32], Err(&bad("is no PEM")));
        assert_eq!(seen, CheckResult::Unusable("c.pem: is no PEM".into()));
        assert_eq!(
            checks.judge([2; 32], Err(&bad("is no PEM"))),
            CheckResult::Same
        );
        assert_eq!(checks.judge([2; 32], Ok([2; 32])), CheckResult::Same);
        assert_eq!(
            checks.judge([2; 32], Err(&bad("is no PEM"))),
            CheckResult::Same
        );
        assert!(matches!(
            checks.judge([2; 32], Err(&bad("is no PEM"))),
            CheckResult::Unusable(_)
        ));
    }
}
