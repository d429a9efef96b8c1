//! Who is let in, as it is set.

use std::path::PathBuf;

use super::{rights::Visibility, tls::TlsFiles};

/// Who is let in.
#[derive(Debug, Clone, Default)]
pub struct Access {
    /// Certificate and key of this coordinator; without, it speaks plain HTTP/2.
    pub tls: Option<TlsFiles>,
    /// The token file; without one and without client certificates, anyone may do anything.
    pub tokens: Option<PathBuf>,
    /// What callers see of others' jobs.
    pub visibility: Visibility,
}

impl Access {
    /// Whether callers must prove who they are.
    pub fn authenticates(&self) -> bool {
        self.tokens.is_some() || self.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some())
    }
}
