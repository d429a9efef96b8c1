//! Identifies callers by their credentials, and reads the token file again after each change.

use std::{
    collections::BTreeMap,
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use picofarm_credentials::Described;
use picofarm_proto::{
    messages::{Act, Outcome, audit::WHO_BYTES},
    show,
};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::{
    access::Access,
    caller::Caller,
    expiry::Expiry,
    roles::Role,
    tokens::{Entry, TokenError, Tokens},
    trust::{CredentialFile, FileTrouble, FileVerdict, GRACE, Judge, Reader, Trust, too_slow},
};
use crate::observe::{
    audit::{Audit, COORDINATOR},
    health::Health,
};

/// Interval between checks of the token file.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Identifies callers by their credentials.
#[derive(Clone)]
pub(crate) struct Gate {
    required: RequiredCredentials,
    trust: watch::Receiver<Trust>,
}

/// The credentials that callers must present.
#[derive(Clone, Copy, PartialEq, Eq)]
enum RequiredCredentials {
    /// None.
    Nothing,
    /// A token, or a certificate that the token file names.
    Token,
    /// Any certificate of the client CA, for the roles submit and work.
    Certificate,
}

impl Gate {
    /// Creates the gate that `access` requires. The token file is read now, and again after each
    /// change, until `stop`.
    ///
    /// # Errors
    /// Returns an error if the token file cannot be used.
    pub(crate) fn new(
        access: &Access,
        audit: &Audit,
        health: Arc<Health>,
        stop: CancellationToken,
    ) -> Result<(Self, Judge), TokenError> {
        let tokens = match &access.tokens {
            Some(path) => Tokens::read(path)?,
            None => Tokens::default(),
        };
        let (judge, trust) = Judge::new(Trust::new(tokens), health);
        let required = match &access.tokens {
            Some(path) => {
                tokio::spawn(follow(path.clone(), judge.clone(), audit.clone(), stop));
                RequiredCredentials::Token
            }
            None if access.authenticates() => RequiredCredentials::Certificate,
            None => RequiredCredentials::Nothing,
        };
        Ok((Self { required, trust }, judge))
    }

    /// Returns the callers with a bound of their own, with `bound` of each.
    pub(crate) fn bounds<T>(&self, bound: impl Fn(&Entry) -> Option<T>) -> BTreeMap<String, T> {
        let trust = self.trust.borrow();
        let entries = trust.tokens.entries().iter();
        let bounded = entries.filter_map(|e| Some((e.name.clone(), bound(e)?)));
        bounded.collect()
    }

    /// Identifies the caller, on a connection that began when the client certificate authorities
    /// had changed `authorities` times.
    ///
    /// # Errors
    /// Returns UNAUTHENTICATED with a remedy, or UNAVAILABLE while no caller can be checked.
    pub(crate) fn admit(
        &self,
        token: Option<&str>,
        certificate: Option<&Described>,
        authorities: u64,
    ) -> Result<Caller, Status> {
        if self.required == RequiredCredentials::Nothing {
            return Ok(Caller::anyone());
        }
        let now = self.trust.borrow();
        now.judge_connection(authorities)?;
        let mut caller = match self.required {
            RequiredCredentials::Nothing | RequiredCredentials::Certificate => {
                by_certificate_alone(certificate)?
            }
            RequiredCredentials::Token => {
                let entry = entry(&now.tokens, token, certificate)?;
                Caller {
                    name: entry.name.as_str().into(),
                    roles: entry.roles.clone(),
                    entry: Some(Arc::new(entry.clone())),
                    until: entry.expires,
                    authorities,
                    trust: None,
                }
            }
        };
        let valid = certificate.map(|c| Expiry::from_seconds(c.not_after));
        caller.until = caller.until.into_iter().chain(valid).min();
        caller.authorities = authorities;
        caller.trust = Some(self.trust.clone());
        match caller.until {
            Some(until) if until.is_over(SystemTime::now()) => Err(caller.expired(until)),
            _ => Ok(caller),
        }
    }

    /// Returns whether the token with this SHA-256 is accepted now, and why.
    pub(crate) fn accepts_digest(&self, digest: &[u8]) -> (bool, String) {
        match self.required {
            RequiredCredentials::Nothing => (true, "it asks nobody for a token".into()),
            RequiredCredentials::Certificate => {
                (false, "it takes client certificates and no tokens".into())
            }
            RequiredCredentials::Token => self.accepts(|tokens| tokens.by_digest(digest)),
        }
    }

    /// Returns whether a client certificate with this name is accepted now, and why.
    pub(crate) fn accepts_certificate(&self, name: &str) -> (bool, String) {
        match self.required {
            RequiredCredentials::Nothing => (true, "it asks nobody for a certificate".into()),
            RequiredCredentials::Certificate => {
                (true, "it takes every certificate of its --client-ca".into())
            }
            RequiredCredentials::Token => self.accepts(|tokens| {
                let mut entries = tokens.entries().iter();
                entries.find(|e| e.certificate.as_deref() == Some(name))
            }),
        }
    }

    fn accepts(&self, find: impl FnOnce(&Tokens) -> Option<&Entry>) -> (bool, String) {
        let now = self.trust.borrow();
        if let Err(refused) = now.judge_connection(now.authorities) {
            return (false, refused.message().to_owned());
        }
        match find(&now.tokens).map(|entry| entry.expires) {
            None => (false, "it is not in the token file".into()),
            Some(Some(expires)) if expires.is_over(SystemTime::now()) => {
                (false, format!("it expired at {expires}"))
            }
            Some(_) => (true, "it is in the token file".into()),
        }
    }
}

fn entry<'a>(
    tokens: &'a Tokens,
    token: Option<&str>,
    certificate: Option<&Described>,
) -> Result<&'a Entry, Status> {
    match token {
        Some(token) => tokens.by_token(token).ok_or_else(|| {
            Status::unauthenticated(
                "the token is not known to this coordinator: it was revoked, or is of another farm; ask for a new one \
                 (`picofarm token create`)",
            )
        }),
        None => certificate.and_then(|c| tokens.by_certificate(c)).ok_or_else(|| {
            Status::unauthenticated(
                "this coordinator wants a token: set PICOFARM_TOKEN or --token-file (`picofarm token create` makes one)",
            )
        }),
    }
}

fn by_certificate_alone(certificate: Option<&Described>) -> Result<Caller, Status> {
    let name = certificate.and_then(|c| c.common_name.clone().or_else(|| c.names.first().cloned()));
    let name = name.ok_or_else(|| {
        Status::unauthenticated(
            "the client certificate has no name; make one with a common name or a DNS name",
        )
    })?;
    // The name appears in jobs and logs.
    if name.len() > WHO_BYTES || show::line(&name) != name {
        return Err(Status::unauthenticated(format!(
            "the client certificate's name has control characters or more than {WHO_BYTES} bytes; make one with a plain name"
        )));
    }
    Ok(Caller {
        name: name.into(),
        roles: vec![Role::Submit, Role::Work].into(),
        entry: None,
        until: None,
        authorities: 0,
        trust: None,
    })
}

/// Reads the token file repeatedly. A file that cannot be used for a moment changes nothing, so
/// that a mistake in an editor does not stop the farm. After [`GRACE`] every caller is refused
/// until the file can be used again.
async fn follow(path: PathBuf, judge: Judge, audit: Audit, stop: CancellationToken) {
    let (mut reader, mut trouble) = (Reader::default(), FileTrouble::default());
    loop {
        tokio::select! {
            () = tokio::time::sleep(CHECK_INTERVAL) => {}
            () = stop.cancelled() => return,
        }
        let file = path.clone();
        let read = match reader.read(move || Tokens::read(&file)).await {
            Some(read) => read.map_err(|e| e.to_string()),
            None => Err(format!("{}: {}", path.display(), too_slow())),
        };
        let why = read.as_ref().err().cloned();
        match trouble.judge(why.as_deref(), Instant::now()) {
            FileVerdict::Same => {}
            FileVerdict::Warn => {
                let complaint = why.clone().unwrap_or_default();
                tracing::error!(
                    "{complaint}; every caller is refused unless this is repaired within {} s",
                    GRACE.as_secs()
                );
                audit.note(COORDINATOR, Act::Tokens, Outcome::Failed, &complaint);
            }
            FileVerdict::Close => {
                let complaint = why.clone().unwrap_or_default();
                tracing::error!("{complaint}; every caller is refused until this is repaired");
                let line = format!("every caller is refused: {complaint}");
                audit.note(COORDINATOR, Act::Tokens, Outcome::Failed, &line);
                judge.fault(CredentialFile::Tokens, why.clone());
            }
            FileVerdict::Reopen => {
                tracing::info!(file = %path.display(), "the token file can be read again");
                let line = "the token file can be read again";
                audit.note(COORDINATOR, Act::Tokens, Outcome::Done, line);
            }
        }
        let Ok(tokens) = read else { continue };
        let mut what = String::new();
        judge.change(|trust| {
            let changed = *trust.tokens != tokens;
            if changed {
                what = trust.tokens.difference(&tokens);
                trust.tokens = Arc::new(tokens);
            }
            changed
        });
        // This comes after the new list is in force, so that the old one admits nobody.
        judge.fault(CredentialFile::Tokens, None);
        if !what.is_empty() {
            tracing::info!(file = %path.display(), "the token file was read again");
            audit.note(COORDINATOR, Act::Tokens, Outcome::Done, &what);
        }
    }
}
