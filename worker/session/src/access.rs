//! TLS, credentials and diagnostics of connections to a coordinator.

use std::{
    error::Error as _,
    net::{IpAddr, SocketAddr},
    path::PathBuf,
    sync::Arc,
    time::Duration,
};

use http::Uri;
use picofarm_credentials::{CredentialError, Pair, Secret, certificates};
use rustls::{
    AlertDescription, CertificateError, ClientConfig, RootCertStore,
    pki_types::{PrivateKeyDer, ServerName, pem::PemObject},
};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};
use tonic::{
    Request, Status,
    metadata::{Ascii, MetadataValue},
    service::Interceptor,
    transport::{Certificate, ClientTlsConfig, Endpoint, Identity},
};

/// Credentials of a client or worker, and the certificate authorities it trusts.
#[derive(Debug, Clone, Default)]
pub struct Access {
    /// Certificate authorities (PEM) for the coordinator's certificate; by default, those of the
    /// system.
    pub ca: Option<PathBuf>,
    /// Client certificate (PEM), for coordinators that require one.
    pub certificate: Option<PathBuf>,
    /// Its private key (PEM).
    pub key: Option<PathBuf>,
    /// Bearer token that identifies the caller.
    pub token: Option<Secret>,
}

/// A reason why a coordinator cannot be reached with these settings.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// The URL cannot be used.
    #[error(
        "{url:?} is not a usable URL ({why}); expected e.g. http://127.0.0.1:7420 or https://farm.example:7420"
    )]
    Url {
        /// The URL.
        url: String,
        /// The reason.
        why: String,
    },
    /// Inconsistent settings.
    #[error("{0}")]
    Settings(String),
    /// An unusable file.
    #[error(transparent)]
    Credentials(#[from] CredentialError),
}

/// A coordinator's address, and everything needed to call it.
#[derive(Debug, Clone)]
pub struct Target {
    /// The connection settings.
    pub endpoint: Endpoint,
    /// Adds the token to each call.
    pub bearer: Bearer,
    uri: Uri,
    access: Access,
}

/// Adds the token to requests.
#[derive(Debug, Clone, Default)]
pub struct Bearer(Option<Arc<MetadataValue<Ascii>>>);

impl Bearer {
    /// Returns a value that sends this text as the header `authorization` instead of a token.
    ///
    /// # Errors
    /// [`AccessError::Settings`]: the text has characters that are not allowed in a header.
    pub fn plain(text: &str) -> Result<Self, AccessError> {
        let value = text.parse().map_err(|_| {
            AccessError::Settings(format!("{text:?} cannot be sent; expected ASCII letters"))
        })?;
        Ok(Self(Some(Arc::new(value))))
    }
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request
                .metadata_mut()
                .insert("authorization", (**value).clone());
        }
        Ok(request)
    }
}

impl Access {
    /// Checks the URL and reads the files.
    ///
    /// # Errors
    /// [`AccessError`] for an unusable URL or file, or a token that would be sent over a network
    /// without TLS.
    pub fn target(&self, url: &str) -> Result<Target, AccessError> {
        // This is checked first, because no message may repeat a password.
        if url.contains('@') {
            return Err(AccessError::Settings(
                "the coordinator's URL names a user or a password (before an @), which is never sent; leave it out, and give \
                 a token with --token-file or PICOFARM_TOKEN"
                    .into(),
            ));
        }
        let bad = |why: String| AccessError::Url {
            url: url.to_owned(),
            why,
        };
        let uri: Uri = url.parse().map_err(|e| bad(format!("{e}")))?;
        let secure = match uri.scheme_str() {
            Some("http") => false,
            Some("https") => true,
            _ => return Err(bad("it must begin with http:// or https://".into())),
        };
        let host = uri.host().unwrap_or_default();
        if host.is_empty() {
            return Err(bad("it names no host".into()));
        }
        let mut endpoint = Endpoint::from_shared(url.to_owned()).map_err(|e| bad(e.to_string()))?;
        if secure {
            let tls = self.tls()?;
            endpoint = endpoint.tls_config(tls).map_err(|e| {
                AccessError::Settings(format!(
                    "TLS cannot be set up: {}; name the coordinator's certificate authority with --ca",
                    causes(&e)
                ))
            })?;
        } else if self.token.is_some() && !loopback(host) {
            return Err(AccessError::Settings(format!(
                "the token would go to {url} in the clear, for everyone on the way to read; use https:// (the coordinator: \
                 --tls-cert and --tls-key)"
            )));
        }
        Ok(Target {
            endpoint,
            bearer: self.bearer()?,
            uri,
            access: self.clone(),
        })
    }

    fn tls(&self) -> Result<ClientTlsConfig, AccessError> {
        let mut tls = match &self.ca {
            Some(path) => {
                ClientTlsConfig::new().ca_certificate(Certificate::from_pem(certificates(path)?.1))
            }
            None => ClientTlsConfig::new().with_native_roots(),
        };
        match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => {
                let pair = Pair::read(certificate, key)?;
                if let Some(why) = pair.described.out_of_date() {
                    return Err(AccessError::Settings(format!(
                        "{}: the certificate {why}",
                        certificate.display()
                    )));
                }
                tls = tls.identity(Identity::from_pem(&pair.certificate, &pair.key));
            }
            (None, None) => {}
            (Some(_), None) => {
                return Err(AccessError::Settings(
                    "--cert needs --key: the private key of the certificate".into(),
                ));
            }
            (None, Some(_)) => {
                return Err(AccessError::Settings(
                    "--key needs --cert: the certificate of the private key".into(),
                ));
            }
        }
        Ok(tls)
    }

    /// Returns the settings of [`Access::tls`] for rustls, to probe the handshake directly.
    fn rustls(&self) -> Option<ClientConfig> {
        let mut roots = RootCertStore::empty();
        roots.add_parsable_certificates(match &self.ca {
            Some(path) => certificates(path).ok()?.0,
            None => rustls_native_certs::load_native_certs().certs,
        });
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .ok()?
            .with_root_certificates(roots);
        let mut config = match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => {
                let key = PrivateKeyDer::from_pem_file(key).ok()?;
                builder
                    .with_client_auth_cert(certificates(certificate).ok()?.0, key)
                    .ok()?
            }
            _ => builder.with_no_client_auth(),
        };
        config.alpn_protocols.push(b"h2".to_vec());
        Some(config)
    }

    fn bearer(&self) -> Result<Bearer, AccessError> {
        let Some(token) = &self.token else {
            return Ok(Bearer::default());
        };
        let mut value: MetadataValue<Ascii> =
            format!("Bearer {}", token.expose()).parse().map_err(|_| {
                AccessError::Settings(
                    "the token holds characters that no token has; copy it again".into(),
                )
            })?;
        // The token is neither shown by Debug nor stored in HTTP/2's header tables.
        value.set_sensitive(true);
        Ok(Bearer(Some(Arc::new(value))))
    }
}

fn loopback(host: &str) -> bool {
    let host = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

/// Timeout for diagnosing a failure.
const PROBE: Duration = Duration::from_secs(3);

/// A reason why a connection failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trouble {
    /// No answer. This may be temporary.
    Down(String),
    /// The server and this program do not trust or understand each other, so a setting must be
    /// corrected.
    Mismatch(String),
}

impl Target {
    /// Diagnoses a failed connection or call.
    pub async fn trouble(
        &self,
        error: &(dyn std::error::Error + Send + Sync + 'static),
    ) -> Trouble {
        if let Some(error) = rustls_error(error) {
            return Trouble::Mismatch(self.tls_trouble(error));
        }
        // A client certificate is refused after the handshake, and its alert is lost in the
        // connection's background task.
        if self.uri.scheme_str() == Some("https")
            && let Some(error) = self.handshake_error().await
        {
            return Trouble::Mismatch(self.tls_trouble(&error));
        }
        if self.uri.scheme_str() == Some("http") && self.speaks_tls().await {
            return Trouble::Mismatch(format!(
                "{} speaks TLS: use https:// in place of http://, and --ca FILE with its certificate authority",
                self.uri
            ));
        }
        Trouble::Down(causes(error))
    }

    fn tls_trouble(&self, error: &rustls::Error) -> String {
        let uri = &self.uri;
        let host = uri.host().unwrap_or_default();
        let by = match &self.access.ca {
            Some(file) => format!("the authorities in {}", file.display()),
            None => "the authorities of this system".to_owned(),
        };
        match error {
            rustls::Error::InvalidMessage(_) => {
                format!(
                    "{uri} does not speak TLS: use http://, or start the coordinator with --tls-cert and --tls-key"
                )
            }
            rustls::Error::InvalidCertificate(why) => match why {
                CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
                    format!(
                        "the certificate of {uri} has expired; make a new one (--tls-cert of the coordinator)"
                    )
                }
                CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
                    format!(
                        "the certificate of {uri} is not valid yet; compare both machines' clocks"
                    )
                }
                CertificateError::NotValidForName
                | CertificateError::NotValidForNameContext { .. } => {
                    format!(
                        "the certificate of {uri} is not for {host:?}; use a name that it is for, or make one with this name"
                    )
                }
                CertificateError::UnknownIssuer | CertificateError::BadSignature => format!(
                    "the certificate of {uri} is not signed by {by}; give the coordinator's certificate authority with --ca FILE"
                ),
                other => format!(
                    "the certificate of {uri} cannot be trusted: {other}; use one for servers, with the host as subjectAltName \
                     and basicConstraints CA:FALSE (docs/security.md)"
                ),
            },
            rustls::Error::AlertReceived(alert) => match alert {
                AlertDescription::CertificateRequired => {
                    format!(
                        "{uri} wants a client certificate: give one with --cert FILE --key FILE"
                    )
                }
                AlertDescription::CertificateExpired => {
                    format!(
                        "{uri} says that this client's certificate has expired; make a new one (--cert)"
                    )
                }
                AlertDescription::UnknownCA
                | AlertDescription::DecryptError
                | AlertDescription::BadCertificate => {
                    format!(
                        "{uri} does not know the authority that signed this client's certificate; give one (--cert) that the \
                         coordinator's --client-ca has signed"
                    )
                }
                other => format!("{uri} refused the TLS connection: {other:?}"),
            },
            other => format!("no TLS connection with {uri}: {other}"),
        }
    }

    /// Returns rustls's error of a handshake and the first answer after it; `None` if there is no
    /// error or no answer.
    async fn handshake_error(&self) -> Option<rustls::Error> {
        let ask = async {
            let config = self.access.rustls()?;
            let host = self.uri.host()?.trim_matches(['[', ']']);
            let name = ServerName::try_from(host).ok()?.to_owned();
            let stream = self.connect(443).await?;
            let connector = tokio_rustls::TlsConnector::from(Arc::new(config));
            let answer = match connector.connect(name, stream).await {
                Ok(mut stream) => stream.read(&mut [0]).await.map(drop),
                Err(error) => Err(error),
            };
            rustls_error(&answer.err()?).cloned()
        };
        tokio::time::timeout(PROBE, ask).await.ok().flatten()
    }

    async fn connect(&self, port: u16) -> Option<TcpStream> {
        let host = self.uri.host()?.trim_matches(['[', ']']);
        let port = self.uri.port_u16().unwrap_or(port);
        let addresses = tokio::net::lookup_host((host, port)).await.ok()?;
        let addresses: Vec<SocketAddr> = addresses.collect();
        TcpStream::connect(&addresses[..]).await.ok()
    }

    /// Returns whether a plain HTTP/2 greeting is answered with a TLS alert.
    async fn speaks_tls(&self) -> bool {
        let ask = async {
            let mut stream = self.connect(80).await?;
            stream
                .write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n")
                .await
                .ok()?;
            let mut answer = [0; 2];
            stream.read_exact(&mut answer).await.ok()?;
            Some(answer)
        };
        let answer = tokio::time::timeout(PROBE, ask).await;
        // Record type alert (or handshake), and TLS major version.
        matches!(answer, Ok(Some([0x15 | 0x16, 0x03])))
    }
}

/// Returns the rustls error at the root of an error chain.
fn rustls_error<'a>(error: &'a (dyn std::error::Error + 'static)) -> Option<&'a rustls::Error> {
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(found) = error.downcast_ref::<rustls::Error>() {
            return Some(found);
        }
        // An io::Error skips the error inside it: its source is that error's source.
        next = match error.downcast_ref::<std::io::Error>() {
            Some(io) => io
                .get_ref()
                .map(|inner| inner as &(dyn std::error::Error + 'static)),
            None => error.source(),
        };
    }
    None
}

/// Formats an error and its sources on one line, because tonic's own text is only "transport
/// error".
pub(crate) fn causes(error: &(dyn std::error::Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text = format!("{text}: {cause}");
        source = cause.source();
    }
    text
}

/// Returns whether a call failed because of its connection, so that [`Target::trouble`] can
/// diagnose it.
pub fn lost_connection(status: &Status) -> bool {
    status.source().is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_token() -> Access {
        Access {
            token: Some(Secret::new("pf-0123")),
            ..Access::default()
        }
    }

    #[tokio::test]
    async fn a_password_in_the_url_is_refused_and_not_repeated() {
        for url in [
            "http://me:hush@127.0.0.1:1",
            "me:hush@host",
            "https://hush@farm",
        ] {
            let said = Access::default().target(url).unwrap_err().to_string();
            assert!(
                said.contains("--token-file") && !said.contains("hush"),
                "{said}"
            );
        }
    }

    #[tokio::test]
    async fn a_token_never_leaves_the_machine_in_the_clear() {
        for url in ["http://127.0.0.1:1", "http://localhost:1", "http://[::1]:1"] {
            with_token().target(url).unwrap();
        }
        for url in [
            "http://10.1.2.3:1",
            "http://farm.example:1",
            "http://127.0.0.1.evil.example:1",
        ] {
            let said = with_token().target(url).unwrap_err().to_string();
            assert!(
                said.contains("in the clear") && said.contains(url),
                "{said}"
            );
            assert!(!said.contains("pf-0123"));
            Access::default().target(url).unwrap();
        }
    }

    #[tokio::test]
    async fn a_token_is_shown_by_no_debug() {
        let access = with_token();
        let target = access.target("http://127.0.0.1:1").unwrap();
        let shown = format!("{access:?} {target:?} {}", access.token.as_ref().unwrap());
        assert!(!shown.contains("0123"), "{shown}");
    }

    #[tokio::test]
    async fn urls_that_lead_nowhere_are_named() {
        for url in [
            "farm.example:7717",
            "http://",
            "ftp://farm.example",
            "",
            "https://",
        ] {
            let said = Access::default().target(url).unwrap_err().to_string();
            assert!(said.contains(&format!("{url:?}")), "{said}");
        }
    }
}
