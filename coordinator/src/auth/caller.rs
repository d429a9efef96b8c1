//! Whoever called.

use std::{fmt, sync::Arc};

use tokio::sync::watch;
use tonic::Status;

use super::{
    expiry::Expiry,
    roles::{Role, Roles},
    tokens::Entry,
    trust::Trust,
};

/// Whoever called: known by a token or a client certificate, or anyone, where no proof is asked for.
#[derive(Clone)]
pub struct Caller {
    /// Its name in the token file, or its certificate's.
    pub name: Arc<str>,
    /// What it may do.
    pub roles: Roles,
    /// By which entry it is known; none for a certificate that needs none.
    pub(super) entry: Option<Arc<Entry>>,
    /// When its token or its certificate expires.
    pub(super) until: Option<Expiry>,
    /// How often the client certificate authorities had changed when its connection began.
    pub(super) authorities: u64,
    /// What it is judged by; `None` where no proof is asked for.
    pub(super) trust: Option<watch::Receiver<Trust>>,
}

/// The name of callers of whom no proof is asked.
pub(crate) const ANYONE: &str = "anyone";

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

    /// Whether no proof was asked of it: such callers cannot be told apart.
    pub(crate) fn is_anyone(&self) -> bool {
        self.trust.is_none() && self.entry.is_none() && *self.name == *ANYONE
    }

    /// Pends for as long as the caller has the proof and the roles it came with.
    pub async fn revoked(&self) -> Status {
        let Some(trust) = &self.trust else {
            return std::future::pending().await;
        };
        let expired = async {
            match self.until {
                Some(until) => {
                    until.over().await;
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
                // The coordinator is stopping, which says so itself.
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
