//! Whoever called.

use std::{fmt, sync::Arc};

use tokio::sync::watch;
use tonic::Status;

use super::{
    roles::{Role, Roles},
    tokens::{Entry, Tokens},
};

/// Whoever called: known by a token or a client certificate, or anyone, where no proof is asked for.
#[derive(Clone)]
pub struct Caller {
    /// Its name in the token file, or its certificate's.
    pub name: Arc<str>,
    /// What it may do.
    pub roles: Roles,
    pub(super) tokens: Option<watch::Receiver<Arc<Tokens>>>,
    /// By which entry it is known; none for a certificate that needs none.
    pub(super) entry: Option<Arc<Entry>>,
}

/// The name of callers of whom no proof is asked.
pub(crate) const ANYONE: &str = "anyone";

impl Caller {
    pub(super) fn anyone() -> Self {
        Self {
            name: ANYONE.into(),
            roles: vec![Role::Admin].into(),
            tokens: None,
            entry: None,
        }
    }

    /// Whether no proof was asked of it: such callers cannot be told apart.
    pub(crate) fn is_anyone(&self) -> bool {
        self.tokens.is_none() && self.entry.is_none() && *self.name == *ANYONE
    }

    /// Pends for as long as the caller has the proof and the roles it came with.
    pub async fn revoked(&self) -> Status {
        let (Some(tokens), Some(entry)) = (&self.tokens, &self.entry) else {
            return std::future::pending().await;
        };
        let mut tokens = tokens.clone();
        let gone = tokens.wait_for(|now| !now.entries().contains(entry)).await;
        match gone.map(drop) {
            Ok(()) => Status::unauthenticated(format!(
                "the token of {:?} was revoked or its roles were changed",
                self.name
            )),
            // The coordinator is stopping, which says so itself.
            Err(_) => std::future::pending().await,
        }
    }
}

impl fmt::Debug for Caller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Caller({}: {})", self.name, self.roles)
    }
}
