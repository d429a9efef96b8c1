//! `picofarm certificates`: an authority of a farm's own, and the coordinator's certificate.

use std::{
    fs,
    io::Write,
    os::unix::fs::OpenOptionsExt,
    path::Path,
    time::{Duration, SystemTime},
};

use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose, date_time_ymd,
};
use rustls::pki_types::{CertificateDer, pem::PemObject};
use serde_json::json;

use crate::{
    args::Certificates,
    error::{CliError, Code, Result, io},
    files,
    output::Output,
};

/// Size limit of a key file, bytes.
const KEY: u64 = 64 << 10;
const DAY: Duration = Duration::from_secs(86_400);
/// The time for which the authority is valid.
const AUTHORITY: Duration = DAY.saturating_mul(3_650);

/// Makes the authority unless the folder has one, and a new certificate for the coordinator.
///
/// # Errors
/// Fails if a host is no name or address, or a file cannot be read or written. An authority is
/// never replaced.
pub fn run(args: &Certificates, output: Output) -> Result<()> {
    for host in &args.hosts {
        check_host(host)?;
    }
    let folder = &args.folder;
    fs::create_dir_all(folder).map_err(|e| io(folder.display(), &e))?;
    let path = |name: &str| folder.join(name);
    let exists = path("ca.key").exists();
    if !exists && path("ca.pem").exists() {
        let what = "exists without ca.key; use another folder";
        let ca = path("ca.pem");
        return Err(CliError::input(format!("{}: {what}", ca.display())));
    }
    let authority = match exists {
        true => {
            let text = files::read_text(&path("ca.key"), KEY)?;
            let key = KeyPair::from_pem(&text);
            let key = key.map_err(|e| refused(&path("ca.key").display(), &e))?;
            match path("ca.pem").exists() {
                true => check_pair(&path("ca.pem"), &key)?,
                // A run that was interrupted.
                false => write_authority(&path("ca.pem"), &key)?,
            }
            Issuer::new(authority()?, key)
        }
        false => {
            let key = KeyPair::generate().map_err(|e| refused(&"the authority's key", &e))?;
            write(&path("ca.key"), &key.serialize_pem(), 0o600)?;
            write_authority(&path("ca.pem"), &key)?;
            Issuer::new(authority()?, key)
        }
    };
    let hosts = args.hosts.clone();
    let mut server = CertificateParams::new(hosts).map_err(|e| refused(&"--host", &e))?;
    let common = args.hosts.first().map_or("localhost", String::as_str);
    server.distinguished_name.push(DnType::CommonName, common);
    server.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    server.use_authority_key_identifier_extension = true;
    valid(&mut server, DAY.saturating_mul(args.days))?;
    let key = KeyPair::generate().map_err(|e| refused(&"the key", &e))?;
    let signed = server.signed_by(&key, &authority);
    let signed = signed.map_err(|e| refused(&"the certificate", &e))?;
    // The key first: a coordinator that reloads in between keeps the former pair.
    write(&path("farm.key"), &key.serialize_pem(), 0o600)?;
    write(&path("farm.pem"), &signed.pem(), 0o644)?;
    let what = json!({
        "folder": folder, "hosts": args.hosts, "days": args.days, "authority": !exists,
    });
    output.result(&what, || {
        let (at, ca) = (folder.display(), path("ca.pem").display().to_string());
        format!(
            "{}{at}/farm.pem is valid for {} for {} days\n\
             start:   picofarm coordinator --tls-cert {at}/farm.pem --tls-key {at}/farm.key …\n\
             clients: copy {ca} to them; PICOFARM_CA={ca} PICOFARM_COORDINATOR=https://{common}:7420\n\
             keep {at}/ca.key private: the same command renews the certificate with it\n",
            if exists { "" } else { "made an authority for ten years\n" },
            args.hosts.join(", "),
            args.days,
        )
    });
    Ok(())
}

/// Checks that a host is a name or an address, without scheme and port.
fn check_host(host: &str) -> Result<()> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '.' | '_' | '*');
    let is_name = !host.is_empty() && host.len() <= 253 && host.chars().all(plain);
    if is_name || host.parse::<std::net::IpAddr>().is_ok() {
        return Ok(());
    }
    let what = format!("--host {host:?}: expected a name or an address, without scheme and port");
    Err(CliError::input(what))
}

/// Writes the certificate of the authority with this key.
fn write_authority(path: &Path, key: &KeyPair) -> Result<()> {
    let made = CertifiedIssuer::self_signed(authority()?, key);
    let made = made.map_err(|e| refused(&"the authority", &e))?;
    write(path, &made.pem(), 0o644)
}

/// Checks that a certificate is of a key: it contains the public key.
fn check_pair(path: &Path, key: &KeyPair) -> Result<()> {
    let text = files::read_text(path, KEY)?;
    let certificate = CertificateDer::from_pem_slice(text.as_bytes());
    let public = key.public_key_raw();
    let matches = certificate.is_ok_and(|c| c.windows(public.len()).any(|w| w == public));
    match matches {
        true => Ok(()),
        false => {
            let what = "is not the certificate of ca.key; use another folder";
            Err(CliError::input(format!("{}: {what}", path.display())))
        }
    }
}

/// Returns the description of the authority, which is the same for each certificate it signs.
fn authority() -> Result<CertificateParams> {
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let name = "picofarm farm authority";
    params.distinguished_name.push(DnType::CommonName, name);
    valid(&mut params, AUTHORITY)?;
    Ok(params)
}

/// Sets the time of validity: from a day ago, because clocks differ.
fn valid(params: &mut CertificateParams, time: Duration) -> Result<()> {
    let now = SystemTime::UNIX_EPOCH.elapsed().map_err(|e| {
        CliError::new(
            Code::Failed,
            format!("the clock of this machine is before 1970: {e}"),
        )
    })?;
    let epoch = date_time_ymd(1970, 1, 1);
    params.not_before = epoch + now.saturating_sub(DAY);
    params.not_after = epoch + now.saturating_add(time);
    Ok(())
}

fn refused(what: &dyn std::fmt::Display, error: &rcgen::Error) -> CliError {
    CliError::input(format!("{what}: {error}"))
}

/// Writes a file that replaces another at once.
fn write(path: &Path, text: &str, mode: u32) -> Result<()> {
    let failed = |e: std::io::Error| io(path.display(), &e);
    let partial = path.with_extension("partial");
    let _ = fs::remove_file(&partial);
    let mut file = fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(mode)
        .open(&partial)
        .map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)?;
    file.sync_all().map_err(failed)?;
    fs::rename(&partial, path).map_err(failed)
}
