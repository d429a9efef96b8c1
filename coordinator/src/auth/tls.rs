//! The coordinator's certificate, and the authorities of accepted client certificates.

use std::{fmt, path::PathBuf, sync::Arc};

use picofarm_credentials::{CredentialError, Described, Pair, certificates};
use rustls::{
    RootCertStore, ServerConfig,
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    server::WebPkiClientVerifier,
};
use sha2::{Digest, Sha256};

/// Files for TLS, all PEM.
#[derive(Debug, Clone)]
pub struct TlsFiles {
    /// The certificate chain, own certificate first.
    pub certificate: PathBuf,
    /// The private key.
    pub key: PathBuf,
    /// Certificate authorities of clients. Every client must present a certificate of one of them.
    pub client_ca: Option<PathBuf>,
}

/// The content of the files.
pub(crate) struct Loaded {
    pub config: Arc<ServerConfig>,
    /// Digest of all files.
    pub digest: [u8; 32],
    /// Digest of the client certificate authorities.
    pub authorities: [u8; 32],
    /// Description of the certificate's owner and expiry.
    pub about: String,
}

impl fmt::Debug for Loaded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Loaded").field(&self.about).finish()
    }
}

impl TlsFiles {
    /// Reads and checks the files.
    ///
    /// # Errors
    /// Returns a [`CredentialError`] with the file and its fault.
    pub(crate) fn read(&self) -> Result<Loaded, CredentialError> {
        let pair = Pair::read(&self.certificate, &self.key)?;
        let mut digest = Sha256::new();
        for bytes in [&pair.certificate, &pair.key] {
            digest.update((bytes.len() as u64).to_le_bytes());
            digest.update(bytes);
        }
        let provider = Arc::new(ring::default_provider());
        let unusable = |path: &PathBuf, e: &dyn fmt::Display| CredentialError::Unusable {
            path: path.clone(),
            what: format!("cannot be used: {e}"),
        };
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()
            .expect("the provider has the default versions of TLS");
        let mut authorities = [0; 32];
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(path) => {
                let (certificates, pem) = certificates(path)?;
                digest.update(&pem);
                authorities = Sha256::digest(&pem).into();
                let mut roots = RootCertStore::empty();
                for authority in certificates {
                    roots.add(authority).map_err(|e| unusable(path, &e))?;
                }
                let verifier =
                    WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
                builder.with_client_cert_verifier(verifier.build().map_err(|e| unusable(path, &e))?)
            }
        };
        let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&pair.certificate).collect();
        let chain = chain.map_err(|e| unusable(&self.certificate, &e))?;
        let key = PrivateKeyDer::from_pem_slice(&pair.key)
            // The parser's message could quote the file.
            .map_err(|_| unusable(&self.key, &"expected a private key"))?;
        let mut config = builder
            .with_single_cert(chain, key)
            .map_err(|e| unusable(&self.certificate, &e))?;
        config.alpn_protocols = vec![b"h2".to_vec()];
        Ok(Loaded {
            config: Arc::new(config),
            digest: digest.finalize().into(),
            authorities,
            about: about(&pair.described),
        })
    }

    /// Returns whether the client certificate authorities have this digest. Returns `false` if they
    /// cannot be read.
    pub(crate) fn has_authorities(&self, digest: &[u8; 32]) -> bool {
        self.client_ca.as_ref().is_none_or(|path| {
            certificates(path)
                .is_ok_and(|(_, pem)| <[u8; 32]>::from(Sha256::digest(&pem)) == *digest)
        })
    }

    /// Logs noteworthy facts at the start.
    pub(crate) fn tell(&self, loaded: &Loaded) {
        if let Ok((chain, _)) = certificates(&self.certificate)
            && let Ok(described) = Described::of(&chain[0])
            && let Some(why) = described.out_of_date()
        {
            tracing::warn!(
                "{}: the certificate {why}; clients will not connect",
                self.certificate.display()
            );
        }
        tracing::info!(certificate = loaded.about, "TLS");
    }
}

fn about(described: &Described) -> String {
    let name = described.common_name.clone();
    let name = name
        .or_else(|| described.names.first().cloned())
        .unwrap_or_default();
    format!(
        "certificate of {name:?}, valid until {} (seconds since 1970)",
        described.not_after
    )
}
