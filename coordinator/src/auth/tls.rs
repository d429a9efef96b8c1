//! The coordinator's certificate, and whose client certificates it takes.

use std::{path::PathBuf, time::Duration};

use picofarm_proto::credentials::{CredentialError, Pair, certificates};
use tonic::transport::{Certificate, Identity, ServerTlsConfig};

/// How long a handshake may take.
const HANDSHAKE: Duration = Duration::from_secs(10);

/// Files for TLS, all PEM.
#[derive(Debug, Clone)]
pub struct TlsFiles {
    /// The certificate chain, the own one first.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// Certificate authorities of clients: every client must show a certificate of one of them.
    pub client_ca: Option<PathBuf>,
}

impl TlsFiles {
    /// Reads and checks the files.
    ///
    /// # Errors
    /// [`CredentialError`] names the file and what is wrong with it.
    pub(crate) fn read(&self) -> Result<ServerTlsConfig, CredentialError> {
        let pair = Pair::read(&self.certificate, &self.key)?;
        if let Some(why) = pair.described.out_of_date() {
            tracing::warn!(
                "{}: the certificate {why}; clients will not connect",
                self.certificate.display()
            );
        }
        let mut config = ServerTlsConfig::new()
            .identity(Identity::from_pem(&pair.certificate, &pair.key))
            .timeout(HANDSHAKE);
        if let Some(path) = &self.client_ca {
            let (authorities, pem) = certificates(path)?;
            tracing::info!(file = %path.display(), authorities = authorities.len(), "clients must show a certificate");
            config = config.client_ca_root(Certificate::from_pem(pem));
        }
        Ok(config)
    }
}
