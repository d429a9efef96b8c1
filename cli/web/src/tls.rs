//! TLS for browsers on other machines.

use std::{
    path::PathBuf,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use picofarm_credentials::{CredentialError, Pair};
use rustls::{
    ServerConfig,
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
};
use tokio_rustls::TlsAcceptor;

/// Interval at which the files are read again.
const AGAIN: Duration = Duration::from_secs(10);

/// The server's certificate and key, both PEM.
#[derive(Debug, Clone)]
pub struct TlsFiles {
    /// The certificate chain, own certificate first.
    pub certificate: PathBuf,
    /// The private key.
    pub key: PathBuf,
}

/// The files, and their content when it was last read.
pub struct Tls {
    files: TlsFiles,
    read: Mutex<Read>,
}

struct Read {
    at: Instant,
    bytes: [Vec<u8>; 2],
    config: Arc<ServerConfig>,
}

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// Names the file that is not usable, and its fault.
    pub fn open(files: TlsFiles) -> Result<Self, CredentialError> {
        let (bytes, config) = load(&files, None)?.expect("nothing was read before");
        let at = Instant::now();
        Ok(Self {
            files,
            read: Mutex::new(Read { at, bytes, config }),
        })
    }

    /// Returns the acceptor of the next connection. A renewed certificate counts within ten
    /// seconds. One that is not usable is logged, and the last stays.
    pub fn acceptor(&self) -> TlsAcceptor {
        let mut read = self.read.lock().expect("no holder panics");
        if read.at.elapsed() >= AGAIN {
            read.at = Instant::now();
            match load(&self.files, Some(&read.bytes)) {
                Ok(None) => {}
                Ok(Some((bytes, config))) => {
                    (read.bytes, read.config) = (bytes, config);
                    tracing::info!("the certificate of the web server was renewed");
                }
                Err(error) => tracing::warn!(%error, "the web server keeps its certificate"),
            }
        }
        TlsAcceptor::from(Arc::clone(&read.config))
    }
}

/// The bytes of both files, and the settings that follow from them.
type Loaded = ([Vec<u8>; 2], Arc<ServerConfig>);

/// Reads the files; `None` if they are as before.
fn load(
    files: &TlsFiles,
    before: Option<&[Vec<u8>; 2]>,
) -> Result<Option<Loaded>, CredentialError> {
    let pair = Pair::read(&files.certificate, &files.key)?;
    let bytes = [pair.certificate, pair.key];
    if before == Some(&bytes) {
        return Ok(None);
    }
    let unusable = |path: &PathBuf, what: String| CredentialError::Unusable {
        path: path.clone(),
        what,
    };
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes[0]).collect();
    let chain = chain.map_err(|e| unusable(&files.certificate, e.to_string()))?;
    // The parser's message could quote the file.
    let key = PrivateKeyDer::from_pem_slice(&bytes[1])
        .map_err(|_| unusable(&files.key, "expected a private key".into()))?;
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .expect("the provider has the default versions of TLS")
        .with_no_client_auth()
        .with_single_cert(chain, key)
        .map_err(|e| unusable(&files.certificate, format!("cannot be used: {e}")))?;
    Ok(Some((bytes, Arc::new(config))))
}
