//! The caller of a request.

use std::{fmt, sync::Arc};

use tokio::sync::watch;
use tonic::Status;

use super::{
    expiry::Expiry,
    roles::{Role, Roles},
    tokens::Entry,
    trust::Trust,
};
use crate::observe::audit::ANYONE;

/// The caller of a request: known by a token or a client certificate, or anyone if no
/// authentication is required.
#[derive(Clone)]
pub struct Caller {
    /// Name in the token file or in the certificate.
    pub name: Arc<str>,
    /// Roles of the caller.
    pub roles: Roles,
    /// The matching entry of the token file; none for a certificate that needs none.
    pub(super) entry: Option<Arc<Entry>>,
    /// Expiry of the token or certificate.
    pub(super) until: Option<Expiry>,
    /// Number of changes of the client certificate authorities when the connection began.
    pub(super) authorities: u64,
    /// The data that the caller is checked against; `None` if no authentication is required.
    pub(super) trust: Option<watch::Receiver<Trust>>,
}

impl Caller {
    pub(super) fn anyone() -> Self {
        Self {
            name: ANYONE.into(),
            roles: vec![Role::Admin].into(),
            entry: None,
            until: None,
            authorities: 0,
            trust: None,
        }
    }

    /// Returns the caller's own bound on the bytes that its jobs publish, if any.
    pub(crate) fn max_bytes(&self) -> Option<u64> {
        self.entry.as_ref()?.max_bytes
    }

    /// Returns whether the caller was not authenticated. Such callers cannot be distinguished.
    pub(crate) fn is_anyone(&self) -> bool {
        self.trust.is_none() && self.entry.is_none() && *self.name == *ANYONE
    }

    /// Stays pending for as long as the caller keeps its credentials and roles.
    pub async fn revoked(&self) -> Status {
        let Some(trust) = &self.trust else {
            return std::future::pending().await;
        };
        let expired = async {
            match self.until {
                Some(until) => {
                    until.passed().await;
                    self.expired(until)
                }
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            refused = self.refused(trust.clone()) => refused,
            expired = expired => expired,
        }
    }

    pub(super) fn expired(&self, until: Expiry) -> Status {
        Status::unauthenticated(format!(
            "the token or certificate of {:?} expired at {until}; ask for a new one",
            self.name
        ))
    }

    async fn refused(&self, mut trust: watch::Receiver<Trust>) -> Status {
        loop {
            let judged = trust
                .borrow_and_update()
                .judge(self.entry.as_deref(), self.authorities);
            if let Err(refused) = judged {
                return refused;
            }
            if trust.changed().await.is_err() {
                // The coordinator is stopping, and reports that itself.
                return std::future::pending().await;
            }
        }
    }
}

impl fmt::Debug for Caller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Caller({}: {})", self.name, self.roles)
    }
}
