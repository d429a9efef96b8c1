//! Certificates that change while the coordinator runs: the files are looked at like the token file.

use std::{sync::Arc, time::Duration};

use picofarm_credentials::CredentialError;
use picofarm_proto::model::{Act, Outcome};
use rustls::ServerConfig;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::{
    audit::{Audit, COORDINATOR},
    auth::{Loaded, TlsFiles},
};

/// How often the files are looked at.
const LOOK: Duration = Duration::from_secs(1);

/// What a look at the files comes to, given the look before.
#[derive(Debug, PartialEq, Eq)]
enum Seen {
    Same,
    New,
    /// The files cannot be used, for the second time in a row with these words: certificate and key are two files, and
    /// whoever replaces them has one of them new for a moment.
    Unusable(String),
}

/// Judges looks.
#[derive(Default)]
struct Looks {
    complaint: String,
    said: bool,
}

impl Looks {
    fn judge(&mut self, now: [u8; 32], read: Result<[u8; 32], &CredentialError>) -> Seen {
        match read {
            Ok(new) => {
                *self = Self::default();
                if new == now { Seen::Same } else { Seen::New }
            }
            Err(error) => {
                let error = error.to_string();
                if error != self.complaint {
                    (self.complaint, self.said) = (error, false);
                    return Seen::Same;
                }
                if std::mem::replace(&mut self.said, true) {
                    return Seen::Same;
                }
                Seen::Unusable(self.complaint.clone())
            }
        }
    }
}

/// The present certificates, of files that are read again until `stop`. Ones that cannot be used change nothing, and the
/// log says so. Connections keep the certificates that they began with.
pub(crate) fn follow(
    files: TlsFiles,
    loaded: Loaded,
    audit: Audit,
    stop: CancellationToken,
) -> watch::Receiver<Arc<ServerConfig>> {
    let (sender, receiver) = watch::channel(loaded.config);
    let mut now = loaded.digest;
    tokio::spawn(async move {
        let mut looks = Looks::default();
        loop {
            tokio::select! {
                () = tokio::time::sleep(LOOK) => {}
                () = stop.cancelled() => return,
            }
            let read = files.read();
            match looks.judge(now, read.as_ref().map(|loaded| loaded.digest)) {
                Seen::Same => {}
                Seen::New => {
                    let loaded = read.expect("files that cannot be read are not new");
                    now = loaded.digest;
                    sender.send_replace(loaded.config);
                    tracing::info!(certificate = %files.certificate.display(), "the certificates were read again");
                    audit.note(COORDINATOR, Act::Certificates, Outcome::Done, &loaded.about);
                }
                Seen::Unusable(why) => {
                    tracing::error!("{why}; the certificates read before stay in force");
                    audit.note(COORDINATOR, Act::Certificates, Outcome::Failed, &why);
                }
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
        let mut looks = Looks::default();
        assert_eq!(looks.judge([1; 32], Ok([1; 32])), Seen::Same);
        assert_eq!(
            looks.judge([1; 32], Err(&bad("does not match"))),
            Seen::Same
        );
        assert_eq!(looks.judge([1; 32], Ok([2; 32])), Seen::New);
        assert_eq!(looks.judge([2; 32], Err(&bad("is no PEM"))), Seen::Same);
        let seen = looks.judge([2; 32], Err(&bad("is no PEM")));
        assert_eq!(seen, Seen::Unusable("c.pem: is no PEM".into()));
        assert_eq!(looks.judge([2; 32], Err(&bad("is no PEM"))), Seen::Same);
        assert_eq!(looks.judge([2; 32], Ok([2; 32])), Seen::Same);
        assert_eq!(looks.judge([2; 32], Err(&bad("is no PEM"))), Seen::Same);
        assert!(matches!(
            looks.judge([2; 32], Err(&bad("is no PEM"))),
            Seen::Unusable(_)
        ));
    }
}
