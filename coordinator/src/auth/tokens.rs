//! The token file: names, roles, and the SHA-256 of each token. A token itself is shown once, when
//! it is created, and is stored nowhere.

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use picofarm_credentials::{CredentialError, Described, LockedFile, Secret, private, read_text};
use picofarm_proto::spec::check_project;
use rustls::crypto::ring;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

use super::{expiry::Expiry, roles::Roles};

/// Prefix of every token, so that a search finds leaked ones.
pub const TOKEN_PREFIX: &str = "pf-";
/// Largest token file, bytes: a hundred thousand callers.
const LARGEST: u64 = 32 << 20;

/// The reason why the token file cannot be used or changed.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The file cannot be read, or everyone has access to it.
    #[error(transparent)]
    File(#[from] CredentialError),
    /// The file's content is invalid.
    #[error("{}: {what}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The expected content.
        what: String,
    },
}

/// One caller in the token file, known by a token or by the name in a client certificate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Name of the caller, recorded in jobs and workers.
    pub name: String,
    /// Roles of the caller.
    pub roles: Roles,
    /// SHA-256 of the token, hexadecimal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// Common name or alternative name of a client certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub certificate: Option<String>,
    /// The time at which access ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expires: Option<Expiry>,
    /// The most cores that the caller's jobs use at a time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_cores: Option<u32>,
    /// The most bytes that the caller's jobs publish.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_bytes: Option<u64>,
    /// Projects that the caller may name in its jobs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub member: Vec<String>,
    /// Projects in which the caller may change all jobs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub maintainer: Vec<String>,
}

impl Entry {
    /// Returns whether both give the same access. Bounds on cores and bytes are none.
    pub(super) fn gives_access_of(&self, other: &Self) -> bool {
        let bounded = Self {
            max_cores: other.max_cores,
            max_bytes: other.max_bytes,
            ..self.clone()
        };
        bounded == *other
    }
}

/// The content of the token file.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tokens {
    #[serde(default, rename = "caller", skip_serializing_if = "Vec::is_empty")]
    entries: Vec<Entry>,
}

const HEAD: &str = "\
# Who may use this farm. `picofarm token create`, `list` and `revoke` edit this file; a running coordinator notices.
# Roles: view, submit, work, admin. sha256 is that of the token, which is kept nowhere.
# member = [\"PROJECT\"] lets a caller name the project in its jobs; maintainer = [\"PROJECT\"] lets it change all jobs of it.
# In place of sha256, certificate = \"NAME\" knows a client certificate by its common name or an alternative name.
# max_cores = 64 bounds the cores that a caller's jobs use at a time, max_bytes = 2_000_000_000_000 the bytes that they publish.
# expires = \"2027-03-01T08:00:00Z\" ends a caller's access at that time.

";

impl Tokens {
    /// Reads the file.
    ///
    /// # Errors
    /// Returns a [`TokenError`] if the file cannot be read or is open to everyone, or if an entry
    /// is invalid.
    pub fn read(path: &Path) -> Result<Self, TokenError> {
        private(path)?;
        Self::parse(&read_text(path, LARGEST)?).map_err(|what| invalid(path, what))
    }

    /// Changes the file while no other process does. Owner, group, mode and access list stay the
    /// same.
    ///
    /// # Errors
    /// Returns a [`TokenError`] if the file cannot be used or replaced, or the message of `change`.
    /// Nothing is changed in that case.
    pub fn edit<T>(
        path: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, String>,
    ) -> Result<T, TokenError> {
        Self::change(path, LockedFile::open(path)?, change)
    }

    /// Like [`Tokens::edit`], but creates the file if it is missing.
    ///
    /// # Errors
    /// Returns the errors of [`Tokens::edit`].
    pub fn edit_or_create<T>(
        path: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, String>,
    ) -> Result<T, TokenError> {
        Self::change(path, LockedFile::open_or_create(path)?, change)
    }

    fn change<T>(
        path: &Path,
        file: LockedFile,
        change: impl FnOnce(&mut Self) -> Result<T, String>,
    ) -> Result<T, TokenError> {
        let text = String::from_utf8(file.read(LARGEST)?)
            .map_err(|_| invalid(path, "is not a text file; expected UTF-8".into()))?;
        let mut tokens = Self::parse(&text).map_err(|what| invalid(path, what))?;
        let value = change(&mut tokens).map_err(|what| invalid(path, what))?;
        file.replace(tokens.to_text().as_bytes())?;
        Ok(value)
    }

    fn to_text(&self) -> String {
        let text = toml::to_string(self).expect("entries are plain data");
        format!("{HEAD}{text}")
    }

    fn parse(text: &str) -> Result<Self, String> {
        // The parser's message quotes lines of the file, which contain no secret.
        let tokens: Self = toml::from_str(text).map_err(|e| e.to_string().trim_end().to_owned())?;
        for (i, entry) in tokens.entries.iter().enumerate() {
            let at = format!("caller {:?}", entry.name);
            plain_name(&entry.name)?;
            if tokens.entries[..i].iter().any(|e| e.name == entry.name) {
                return Err(format!("{at} is there twice; give each its own name"));
            }
            if entry.roles.is_empty() {
                return Err(format!(
                    "{at} has no roles; give it view, submit, work or admin"
                ));
            }
            if entry.max_cores == Some(0) {
                return Err(format!(
                    "{at}: max_cores must be at least 1; leave it out for no bound"
                ));
            }
            if entry.max_bytes == Some(0) {
                return Err(format!(
                    "{at}: max_bytes must be at least 1; leave it out for no bound"
                ));
            }
            for project in entry.member.iter().chain(&entry.maintainer) {
                check_project(project).map_err(|what| format!("{at}: {what}"))?;
            }
            let digest = |text: &String| hex::decode(text).is_ok_and(|bytes| bytes.len() == 32);
            match (&entry.sha256, &entry.certificate) {
                (Some(sha256), None) if digest(sha256) => {}
                (Some(_), None) => {
                    return Err(format!(
                        "{at}: sha256 must be 64 hexadecimal digits: the SHA-256 of the token, not the token"
                    ));
                }
                (None, Some(name)) if !name.is_empty() => {}
                _ => return Err(format!("{at} needs either sha256 or certificate")),
            }
        }
        Ok(tokens)
    }

    /// Returns all callers.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Describes the difference between these tokens and `new`, by the names of callers only.
    pub(crate) fn difference(&self, new: &Self) -> String {
        let named = |tokens: &Self, name: &str| tokens.entries.iter().any(|e| e.name == name);
        let mut parts = Vec::new();
        let mut part = |what: &str, names: Vec<&str>| {
            if !names.is_empty() {
                parts.push(format!("{what}: {}", names.join(", ")));
            }
        };
        let added = new.entries.iter().map(|e| e.name.as_str());
        part("added", added.filter(|n| !named(self, n)).collect());
        let removed = self.entries.iter().map(|e| e.name.as_str());
        part("removed", removed.filter(|n| !named(new, n)).collect());
        let changed = new.entries.iter().filter(|e| named(self, &e.name));
        let changed = changed.filter(|e| !self.entries.contains(e));
        part("changed", changed.map(|e| e.name.as_str()).collect());
        match parts.is_empty() {
            true => "the order of callers".into(),
            false => parts.join("; "),
        }
    }

    /// Returns the owner of a token. Takes the same time for every token.
    pub fn by_token(&self, token: &str) -> Option<&Entry> {
        self.by_digest(&Sha256::digest(token))
    }

    /// Returns the owner of a client certificate.
    pub fn by_certificate(&self, certificate: &Described) -> Option<&Entry> {
        self.entries.iter().find(|entry| {
            let name = entry.certificate.as_deref();
            name.is_some_and(|name| certificate.is(name))
        })
    }

    /// Returns the entry with this name.
    pub fn by_name(&self, name: &str) -> Option<&Entry> {
        self.entries.iter().find(|entry| entry.name == name)
    }

    /// Returns the owner of the token with this SHA-256.
    pub(crate) fn by_digest(&self, digest: &[u8]) -> Option<&Entry> {
        let mut found = None;
        for entry in &self.entries {
            let Some(sha256) = &entry.sha256 else {
                continue;
            };
            let known = hex::decode(sha256).expect("checked when it was read");
            if bool::from(known.ct_eq(digest)) {
                found = Some(entry);
            }
        }
        found
    }

    /// Creates a token for a new caller and adds it, with the projects in which the caller is a
    /// member and a maintainer. The token never expires.
    ///
    /// # Errors
    /// Returns a message if the name is taken or not plain, a project's name is not plain, or there
    /// are no roles.
    pub fn create(
        &mut self,
        name: &str,
        roles: Roles,
        member: Vec<String>,
        maintainer: Vec<String>,
    ) -> Result<Secret, String> {
        self.create_until(name, roles, member, maintainer, None)
    }

    /// Like [`Tokens::create`], for a token that expires.
    ///
    /// # Errors
    /// Returns the errors of [`Tokens::create`].
    pub fn create_until(
        &mut self,
        name: &str,
        roles: Roles,
        member: Vec<String>,
        maintainer: Vec<String>,
        expires: Option<Expiry>,
    ) -> Result<Secret, String> {
        plain_name(name)?;
        for project in member.iter().chain(&maintainer) {
            check_project(project)?;
        }
        if self.entries.iter().any(|e| e.name == name) {
            return Err(format!(
                "there is a caller {name:?} already; revoke it first, or choose another name"
            ));
        }
        if roles.is_empty() {
            return Err("a token needs at least one role".into());
        }
        let mut random = [0; 32];
        ring::default_provider()
            .secure_random
            .fill(&mut random)
            .map_err(|_| "the system gives no random numbers")?;
        let token = format!("{TOKEN_PREFIX}{}", hex::encode(random));
        self.entries.push(Entry {
            name: name.to_owned(),
            roles,
            sha256: Some(hex::encode(Sha256::digest(&token))),
            certificate: None,
            expires,
            max_cores: None,
            max_bytes: None,
            member,
            maintainer,
        });
        Ok(Secret::new(token))
    }

    /// Bounds the cores that a caller's jobs use at a time, and the bytes that they publish; `None`
    /// removes a bound.
    ///
    /// # Errors
    /// Returns a message if no caller has this name.
    pub fn bound(
        &mut self,
        name: &str,
        cores: Option<u32>,
        bytes: Option<u64>,
    ) -> Result<(), String> {
        let entry = self.entries.iter_mut().find(|e| e.name == name);
        let entry = entry.ok_or_else(|| format!("there is no caller {name:?}"))?;
        (entry.max_cores, entry.max_bytes) = (cores, bytes);
        Ok(())
    }

    /// Removes a caller. Returns `false` if no caller has this name.
    pub fn revoke(&mut self, name: &str) -> bool {
        let before = self.entries.len();
        self.entries.retain(|e| e.name != name);
        self.entries.len() < before
    }

    /// Writes the file atomically. A new file is accessible only to its owner.
    ///
    /// # Errors
    /// Returns a [`TokenError`] if the file cannot be written or is open to everyone.
    pub fn write(&self, path: &Path) -> Result<(), TokenError> {
        let file = LockedFile::open_or_create(path)?;
        Ok(file.replace(self.to_text().as_bytes())?)
    }
}

fn invalid(path: &Path, what: String) -> TokenError {
    TokenError::Invalid {
        path: path.to_owned(),
        what,
    }
}

/// Names appear in logs, job lists and label values.
fn plain_name(name: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.@".contains(c);
    if name.is_empty() || name.len() > 64 || !name.chars().all(plain) {
        return Err(format!(
            "{name:?} is no name: expected up to 64 letters, digits, '-', '_', '.' and '@'"
        ));
    }
    Ok(())
}
