//! Certificates, keys and secrets on disk, read the same way by both sides. Every error names the
//! file and the remedy, and no secret can reach a log.

mod locked;

use std::{
    fmt,
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use rustls::{
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    sign::CertifiedKey,
};
use x509_parser::{
    extensions::GeneralName,
    prelude::{FromDer, X509Certificate},
};

pub use locked::LockedFile;

/// Largest file with a secret, bytes.
const LARGEST_SECRET: u64 = 1 << 20;
/// Largest file with certificates or a key, bytes: a system's list of authorities is some 300 kB.
const LARGEST_PEM: u64 = 16 << 20;

/// A secret text. Neither `Debug` nor `Display` shows it; only [`Secret::expose`] does.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// Wraps a secret.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// Returns the secret itself, for the single place that needs it.
    pub fn expose(&self) -> &str {
        &self.0
    }

    /// Reads the first line of a file to which others have no access.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, is empty, or is open to everyone on the
    /// machine.
    pub fn read(path: &Path) -> Result<Self, CredentialError> {
        private(path)?;
        // The path may be a pipe, e.g. of a secret manager.
        let text = text(path, read_bytes(path, LARGEST_SECRET)?)?;
        let line = text.lines().next().unwrap_or_default().trim();
        if line.is_empty() {
            return Err(CredentialError::unusable(
                path,
                "is empty; expected one line with the secret",
            ));
        }
        Ok(Self(line.to_owned()))
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

impl fmt::Display for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("…")
    }
}

/// An unusable file with credentials.
#[derive(Debug, thiserror::Error)]
pub enum CredentialError {
    /// The file cannot be read.
    #[error("{}: {source}; check the path and that this user may read it", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file cannot be written.
    #[error("{}: {source}; check that this user may write there", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// Everyone on the machine has access to the file.
    #[error(
        "{}: others than its owner and group have access to it (mode {mode:03o}); run `chmod o-rwx {}`",
        path.display(), path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The file's content is invalid.
    #[error("{}: {what}", path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
        /// The expected content.
        what: String,
    },
}

impl CredentialError {
    fn read(path: &Path, source: io::Error) -> Self {
        Self::Read {
            path: path.to_owned(),
            source,
        }
    }

    fn write(path: &Path, source: io::Error) -> Self {
        Self::Write {
            path: path.to_owned(),
            source,
        }
    }

    fn unusable(path: &Path, what: impl Into<String>) -> Self {
        Self::Unusable {
            path: path.to_owned(),
            what: what.into(),
        }
    }
}

/// Refuses a file that everyone on the machine may read or write.
///
/// # Errors
/// Returns [`CredentialError::Open`], or an error if the file is missing.
pub fn private(path: &Path) -> Result<(), CredentialError> {
    use std::os::unix::fs::PermissionsExt;
    let metadata = std::fs::metadata(path).map_err(|e| CredentialError::read(path, e))?;
    let mode = metadata.permissions().mode() & 0o777;
    if metadata.is_file() && mode & 0o007 != 0 {
        return Err(CredentialError::Open {
            path: path.to_owned(),
            mode,
        });
    }
    Ok(())
}

/// Reads a file of at most `most` bytes.
///
/// # Errors
/// Returns an error if the file cannot be read, or is larger.
pub fn read_bytes(path: &Path, most: u64) -> Result<Vec<u8>, CredentialError> {
    let file = File::open(path).map_err(|e| CredentialError::read(path, e))?;
    read_at_most(&file, path, most)
}

/// Reads a regular text file of at most `most` bytes. It does not wait for a pipe.
///
/// # Errors
/// Returns an error if the file cannot be read, is not a regular file, is larger, or is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> Result<String, CredentialError> {
    let metadata = std::fs::metadata(path).map_err(|e| CredentialError::read(path, e))?;
    if !metadata.is_file() {
        return Err(CredentialError::unusable(
            path,
            "is not a regular file; give the path of one",
        ));
    }
    text(path, read_bytes(path, most)?)
}

fn text(path: &Path, bytes: Vec<u8>) -> Result<String, CredentialError> {
    String::from_utf8(bytes)
        .map_err(|_| CredentialError::unusable(path, "is not a text file; expected UTF-8"))
}

fn read_at_most(file: &File, path: &Path, most: u64) -> Result<Vec<u8>, CredentialError> {
    let mut bytes = Vec::new();
    file.take(most.saturating_add(1))
        .read_to_end(&mut bytes)
        .map_err(|e| CredentialError::read(path, e))?;
    if bytes.len() as u64 > most {
        return Err(CredentialError::unusable(
            path,
            format!("has more than {most} bytes, the most that such a file may have"),
        ));
    }
    Ok(bytes)
}

/// Reads the certificates of a PEM file, and its bytes.
///
/// # Errors
/// Returns an error if the file cannot be read, or contains no certificate.
pub fn certificates(
    path: &Path,
) -> Result<(Vec<CertificateDer<'static>>, Vec<u8>), CredentialError> {
    let bytes = read_bytes(path, LARGEST_PEM)?;
    let parsed: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    let found = parsed.map_err(|e| {
        CredentialError::unusable(
            path,
            format!("is no PEM file ({e}); {EXPECTED_CERTIFICATE}"),
        )
    })?;
    for der in &found {
        Described::of(der).map_err(|what| {
            CredentialError::unusable(path, format!("holds a certificate that {what}"))
        })?;
    }
    if found.is_empty() {
        return Err(CredentialError::unusable(
            path,
            format!("holds no certificate; {EXPECTED_CERTIFICATE}"),
        ));
    }
    Ok((found, bytes))
}

const EXPECTED_CERTIFICATE: &str = "expected PEM with -----BEGIN CERTIFICATE-----";

/// A certificate chain with its private key, as PEM.
#[derive(Clone)]
pub struct Pair {
    /// The chain, own certificate first.
    pub certificate: Vec<u8>,
    /// The private key.
    pub key: Vec<u8>,
    /// Description of the own certificate.
    pub described: Described,
}

impl fmt::Debug for Pair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Pair").field(&self.described).finish()
    }
}

impl Pair {
    /// Reads a certificate chain and its key, and checks that they belong together.
    ///
    /// # Errors
    /// Returns an error if a file cannot be read or is not PEM, if the key is open to everyone, or
    /// if it belongs to another certificate.
    pub fn read(certificate: &Path, key: &Path) -> Result<Self, CredentialError> {
        let (chain, certificate_pem) = certificates(certificate)?;
        private(key)?;
        let key_pem = read_bytes(key, LARGEST_PEM)?;
        let secret = PrivateKeyDer::from_pem_slice(&key_pem).map_err(|_| {
            // The parser's message could quote the file.
            CredentialError::unusable(
                key,
                "holds no private key; expected PEM with -----BEGIN PRIVATE KEY-----",
            )
        })?;
        let described = Described::of(&chain[0]).expect("it was described when it was read");
        let matched = CertifiedKey::from_der(chain, secret, &ring::default_provider());
        matched.map_err(|e| {
            let what = match e {
                rustls::Error::InconsistentKeys(_) => format!(
                    "the key does not match the certificate {}; give the key that this certificate was made with",
                    certificate.display()
                ),
                other => format!("the key cannot be used ({other}); make one with e.g. ECDSA P-256"),
            };
            CredentialError::unusable(key, what)
        })?;
        Ok(Self {
            certificate: certificate_pem,
            key: key_pem,
            described,
        })
    }
}

/// The identity and validity in a certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Described {
    /// Common name, if any.
    pub common_name: Option<String>,
    /// Alternative names: DNS names, and URIs such as SPIFFE ids.
    pub names: Vec<String>,
    /// Valid from, seconds since 1970.
    pub not_before: i64,
    /// Valid until, seconds since 1970.
    pub not_after: i64,
}

impl Described {
    /// Parses a certificate.
    ///
    /// # Errors
    /// Returns a description of the fault, in words that follow "a certificate that".
    pub fn of(der: &[u8]) -> Result<Self, String> {
        let (_, parsed) = X509Certificate::from_der(der)
            .map_err(|e| format!("cannot be read ({e}); make it again"))?;
        let common_name = parsed
            .subject()
            .iter_common_name()
            .next()
            .and_then(|name| name.as_str().ok())
            .map(str::to_owned);
        let names = match parsed.subject_alternative_name() {
            Ok(Some(names)) => names.value.general_names.iter().filter_map(named).collect(),
            _ => Vec::new(),
        };
        Ok(Self {
            common_name,
            names,
            not_before: parsed.validity().not_before.timestamp(),
            not_after: parsed.validity().not_after.timestamp(),
        })
    }

    /// Returns whether `name` is a name of the certificate.
    pub fn is(&self, name: &str) -> bool {
        self.common_name.as_deref() == Some(name) || self.names.iter().any(|n| n == name)
    }

    /// Returns why the certificate is not valid now, if so.
    pub fn out_of_date(&self) -> Option<&'static str> {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH);
        let now = since_1970.map_or(0, |d| i64::try_from(d.as_secs()).unwrap_or(i64::MAX));
        if now > self.not_after {
            Some("has expired; make a new one")
        } else if now < self.not_before {
            Some("is not valid yet; check this machine's clock")
        } else {
            None
        }
    }
}

fn named(name: &GeneralName<'_>) -> Option<String> {
    match name {
        GeneralName::DNSName(name) | GeneralName::URI(name) => Some((*name).to_owned()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endless_file_is_refused_by_name() {
        for read in [
            Secret::read(Path::new("/dev/zero")).map(drop),
            certificates(Path::new("/dev/zero")).map(drop),
        ] {
            let said = read.unwrap_err().to_string();
            assert!(said.starts_with("/dev/zero: has more than"), "{said}");
        }
    }
}
