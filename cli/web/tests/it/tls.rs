//! Encrypted connections.

use std::{path::Path, sync::Arc};

use picofarm_web::{Server, Settings, StartError, TlsFiles};
use rustls::{ClientConfig, RootCertStore, crypto::ring, pki_types::ServerName};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};
use tokio_rustls::TlsConnector;
use tokio_util::sync::CancellationToken;

use crate::farm::Memory;

/// Writes a certificate for `localhost` and its key.
fn certificate(folder: &Path) -> (TlsFiles, RootCertStore) {
    let made = rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).unwrap();
    let files = TlsFiles {
        certificate: folder.join("c.pem"),
        key: folder.join("k.pem"),
    };
    std::fs::write(&files.certificate, made.cert.pem()).unwrap();
    std::fs::write(&files.key, made.signing_key.serialize_pem()).unwrap();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let private = std::fs::Permissions::from_mode(0o600);
        std::fs::set_permissions(&files.key, private).unwrap();
    }
    let mut roots = RootCertStore::empty();
    roots.add(made.cert.der().clone()).unwrap();
    (files, roots)
}

fn settings(tls: TlsFiles) -> Settings {
    Settings {
        listen: "127.0.0.1:0".parse().unwrap(),
        hosts: vec!["localhost".into()],
        tls: Some(tls),
        allow_insecure: false,
        stores: Vec::new(),
        farm: true,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_a_certificate_answers_are_encrypted_and_the_cookie_is_secure() {
    let folder = tempfile::tempdir().unwrap();
    let (files, roots) = certificate(folder.path());
    let server = Server::bind(settings(files), Arc::new(Memory::default()));
    let server = server.await.unwrap();
    let (address, link) = (server.address(), server.link("/"));
    let port = address.port();
    assert!(link.starts_with(&format!("https://localhost:{port}/?key=")));
    let stop = CancellationToken::new();
    let serving = tokio::spawn(server.serve(stop.clone()));

    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let connector = TlsConnector::from(Arc::new(config));
    let name = ServerName::try_from("localhost").unwrap();
    let stream = TcpStream::connect(address).await.unwrap();
    let mut stream = connector.connect(name, stream).await.unwrap();
    let path = link.split_once(&port.to_string()).unwrap().1;
    let request =
        format!("GET {path} HTTP/1.1\r\nHost: localhost:{port}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.unwrap();
    let answer = String::from_utf8(answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 303"), "{answer}");
    let cookie = answer.lines().find(|line| line.starts_with("set-cookie: "));
    let cookie = cookie.expect(&answer);
    assert!(cookie.contains("__Host-picofarm-"), "{cookie}");
    for flag in ["Secure", "HttpOnly", "SameSite=Lax"] {
        assert!(cookie.contains(flag), "{cookie}");
    }

    // A request that is not encrypted gets no page.
    let mut clear = TcpStream::connect(address).await.unwrap();
    clear.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    let _ = clear.read_to_end(&mut answer).await;
    assert!(!String::from_utf8_lossy(&answer).contains("HTTP/"));
    stop.cancel();
    serving.await.unwrap();
}

#[tokio::test]
async fn a_key_of_another_certificate_is_refused_with_its_file() {
    let (one, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (mut files, _) = certificate(one.path());
    files.key = certificate(other.path()).0.key;
    let bound = Server::bind(settings(files), Arc::new(Memory::default())).await;
    let Err(StartError::Certificate(error)) = bound else {
        panic!("expected an error about the certificate, found {bound:?}");
    };
    assert!(error.to_string().contains("k.pem"), "{error}");
}
