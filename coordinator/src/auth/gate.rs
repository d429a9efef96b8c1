//! Who a caller is, by its proof; and the token file, read again whenever it changes.

use std::{path::PathBuf, sync::Arc, time::Duration};

use picofarm_credentials::Described;
use picofarm_proto::{
    model::{Act, Outcome, audit::WHO_BYTES},
    show,
};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::{
    access::Access,
    caller::Caller,
    roles::Role,
    tokens::{TokenError, Tokens},
};
use crate::audit::{Audit, COORDINATOR};

/// How often the token file is looked at.
const LOOK: Duration = Duration::from_secs(1);

/// Knows callers by their proof.
#[derive(Clone)]
pub(crate) enum Gate {
    /// No proof is asked for.
    Open,
    /// A token, or a certificate that the token file names.
    Tokens(watch::Receiver<Arc<Tokens>>),
    /// Any certificate of the client CA, to submit and to work.
    Certificates,
}

impl Gate {
    /// The gate that `access` asks for. The token file is read now, and again whenever it changes, until `stop`.
    ///
    /// # Errors
    /// The token file cannot be used.
    pub(crate) fn new(
        access: &Access,
        audit: &Audit,
        stop: CancellationToken,
    ) -> Result<Self, TokenError> {
        let Some(path) = access.tokens.clone() else {
            return Ok(if access.authenticates() {
                Self::Certificates
            } else {
                Self::Open
            });
        };
        let (sender, receiver) = watch::channel(Arc::new(Tokens::read(&path)?));
        tokio::spawn(follow(path, sender, audit.clone(), stop));
        Ok(Self::Tokens(receiver))
    }

    /// Who it is.
    ///
    /// # Errors
    /// UNAUTHENTICATED, with what to do.
    pub(crate) fn admit(
        &self,
        token: Option<&str>,
        certificate: Option<&Described>,
    ) -> Result<Caller, Status> {
        let tokens = match self {
            Self::Open => return Ok(Caller::anyone()),
            Self::Certificates => return by_certificate_alone(certificate),
            Self::Tokens(tokens) => tokens,
        };
        let now = tokens.borrow();
        let entry = match token {
            Some(token) => now.by_token(token).ok_or_else(|| {
                Status::unauthenticated(
                    "the token is not known to this coordinator: it was revoked, or is of another farm; ask for a new one \
                     (`picofarm token create`)",
                )
            }),
            None => certificate.and_then(|c| now.by_certificate(c)).ok_or_else(|| {
                Status::unauthenticated(
                    "this coordinator wants a token: set PICOFARM_TOKEN or --token-file (`picofarm token create` makes one)",
                )
            }),
        }?;
        Ok(Caller {
            name: entry.name.as_str().into(),
            roles: entry.roles.clone(),
            tokens: Some(tokens.clone()),
            entry: Some(Arc::new(entry.clone())),
        })
    }
}

fn by_certificate_alone(certificate: Option<&Described>) -> Result<Caller, Status> {
    let name = certificate.and_then(|c| c.common_name.clone().or_else(|| c.names.first().cloned()));
    let name = name.ok_or_else(|| {
        Status::unauthenticated(
            "the client certificate has no name; make one with a common name or a DNS name",
        )
    })?;
    // It goes into jobs and logs.
    if name.len() > WHO_BYTES || show::line(&name) != name {
        return Err(Status::unauthenticated(format!(
            "the client certificate's name has control characters or more than {WHO_BYTES} bytes; make one with a plain name"
        )));
    }
    Ok(Caller {
        name: name.into(),
        roles: vec![Role::Submit, Role::Work].into(),
        tokens: None,
        entry: None,
    })
}

/// Reads the token file again and again. One that cannot be used changes nothing, so that a slip of an editor does
/// not stop the farm; the log says so.
async fn follow(
    path: PathBuf,
    sender: watch::Sender<Arc<Tokens>>,
    audit: Audit,
    stop: CancellationToken,
) {
    let mut complaint = String::new();
    loop {
        tokio::select! {
            () = tokio::time::sleep(LOOK) => {}
            () = stop.cancelled() => return,
        }
        match Tokens::read(&path) {
            Ok(tokens) => {
                complaint.clear();
                let mut what = String::new();
                sender.send_if_modified(|now| {
                    let changed = **now != tokens;
                    if changed {
                        what = now.difference(&tokens);
                        *now = Arc::new(tokens);
                    }
                    changed
                });
                if !what.is_empty() {
                    tracing::info!(file = %path.display(), "the token file was read again");
                    audit.note(COORDINATOR, Act::Tokens, Outcome::Done, &what);
                }
            }
            Err(error) if complaint == error.to_string() => {}
            Err(error) => {
                complaint = error.to_string();
                tracing::error!("{complaint}; the tokens read before stay in force");
                audit.note(COORDINATOR, Act::Tokens, Outcome::Failed, &complaint);
            }
        }
    }
}
