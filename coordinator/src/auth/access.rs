//! Configuration of who may connect.

use std::path::PathBuf;

use super::{rights::Visibility, tls::TlsFiles};

/// Who may connect.
#[derive(Debug, Clone, Default)]
pub struct Access {
    /// Certificate and key of this coordinator; without them it speaks plain HTTP/2.
    pub tls: Option<TlsFiles>,
    /// The token file. Without it and without client certificates, anyone may do anything.
    pub tokens: Option<PathBuf>,
    /// Which jobs of others callers see.
    pub visibility: Visibility,
}

impl Access {
    /// Returns whether callers must authenticate.
    pub fn authenticates(&self) -> bool {
        self.tokens.is_some() || self.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some())
    }
}

/// The header with the answer to whether credentials are accepted: `yes` or `no`. The message
/// contains the reason.
pub const ACCEPTED: &str = "picofarm-accepted";

/// The scheme before the SHA-256 of a token in the header `authorization`, to ask whether the token
/// is accepted.
pub const BY_DIGEST: &str = "Sha256";
/// The scheme before the name in a client certificate, to ask whether the certificate is accepted.
pub const BY_CERTIFICATE: &str = "Certificate";
