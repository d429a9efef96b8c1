//! Certificates for tests, and clients that trust them.

use std::{os::unix::fs::PermissionsExt, path::Path, sync::Arc};

use picofarm_coordinator::auth::TlsFiles;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use rustls::{ClientConfig, RootCertStore, crypto::ring, pki_types::ServerName};
use tokio::net::TcpStream;
use tokio_rustls::{TlsConnector, client::TlsStream};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Error, Identity};

pub struct Authority(CertifiedIssuer<'static, KeyPair>);

pub fn authority(name: &str) -> Authority {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, name);
    let key = KeyPair::generate().unwrap();
    Authority(CertifiedIssuer::self_signed(params, key).unwrap())
}

impl Authority {
    pub fn pem(&self) -> String {
        self.0.pem()
    }

    /// Returns a certificate for localhost and its key.
    fn pair(&self) -> (String, String) {
        let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        params
            .distinguished_name
            .push(DnType::CommonName, "somebody");
        let key = KeyPair::generate().unwrap();
        let signed = params.signed_by(&key, &self.0).unwrap();
        (signed.pem(), key.serialize_pem())
    }

    /// Writes the files of a coordinator with a certificate of this authority, one after the other.
    pub fn serve(&self, folder: &Path, clients: Option<&Self>) -> TlsFiles {
        let (certificate, key) = self.pair();
        let write = |name: &str, text: &str| {
            let path = folder.join(name);
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
            path
        };
        TlsFiles {
            certificate: write("server.pem", &certificate),
            key: write("server.key", &key),
            client_ca: clients.map(|by| write("clients.pem", &by.pem())),
        }
    }

    /// Connects a client that trusts this authority, with a certificate of `client`.
    pub async fn channel(&self, port: u16, client: Option<&Self>) -> Result<Channel, Error> {
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(self.pem()));
        if let Some(client) = client {
            let (certificate, key) = client.pair();
            tls = tls.identity(Identity::from_pem(certificate, key));
        }
        let url = format!("https://localhost:{port}");
        Endpoint::from_shared(url)?.tls_config(tls)?.connect().await
    }

    /// Makes a handshake and sends nothing afterwards.
    pub fn handshake(
        &self,
        socket: TcpStream,
    ) -> impl Future<Output = std::io::Result<TlsStream<TcpStream>>> + use<> {
        let mut roots = RootCertStore::empty();
        roots.add(self.0.der().clone()).unwrap();
        let provider = Arc::new(ring::default_provider());
        let mut config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        config.alpn_protocols = vec![b"h2".to_vec()];
        let name = ServerName::try_from("localhost").unwrap();
        let connector = TlsConnector::from(Arc::new(config));
        async move { connector.connect(name, socket).await }
    }
}
