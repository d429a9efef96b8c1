//! Finds out why a connection to a coordinator failed.

use std::{error::Error as _, net::SocketAddr, sync::Arc, time::Duration};

use rustls::{AlertDescription, CertificateError, pki_types::ServerName};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};
use tonic::Status;

use super::Target;

/// Timeout for diagnosing a failure.
const PROBE: Duration = Duration::from_secs(3);

/// A reason why a connection failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ConnectionFailure {
    /// No answer. This may be temporary.
    Down(String),
    /// The server and this program do not trust or understand each other, so a setting must be
    /// corrected.
    Mismatch(String),
}

impl Target {
    /// Diagnoses a failed connection or call.
    pub async fn diagnose(
        &self,
        error: &(dyn std::error::Error + Send + Sync + 'static),
    ) -> ConnectionFailure {
        if let Some(error) = rustls_error(error) {
            return ConnectionFailure::Mismatch(self.describe_tls_error(error));
        }
        // A client certificate is refused after the handshake, and its alert is lost in the
        // connection's background task.
        if self.uri.scheme_str() == Some("https")
            && let Some(error) = self.handshake_error().await
        {
            return ConnectionFailure::Mismatch(self.describe_tls_error(&error));
        }
        if self.uri.scheme_str() == Some("http") && self.speaks_tls().await {
            return ConnectionFailure::Mismatch(format!(
                "{} speaks TLS: use https:// in place of http://, and --ca FILE with its certificate authority",
                self.uri
            ));
        }
        ConnectionFailure::Down(causes(error))
    }

    fn describe_tls_error(&self, error: &rustls::Error) -> String {
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
                other => format!("the certificate of {uri} cannot be trusted: {other}"),
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

/// Returns whether a call failed because of its connection, so that [`Target::diagnose`] can
/// diagnose it.
pub fn lost_connection(status: &Status) -> bool {
    status.source().is_some()
}
